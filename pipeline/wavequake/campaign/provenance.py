"""Where and with what numbers were made: versions, commit, machine, BLAS and OpenCL device."""

import hashlib
import os
import platform
import subprocess
from datetime import UTC, datetime
from functools import lru_cache
from glob import glob
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from threadpoolctl import threadpool_info

from wavequake import __version__
from wavequake.campaign.plugins import loaded_plugins
from wavequake.files import folder
from wavequake.kernels.device.devices import Device, opencl_handle

_PACKAGES = (
    "numpy",
    "scipy",
    "pyopencl",
    "pocl-binary-distribution",
    "xarray",
    "zarr",
    "dask",
    "distributed",
)
_PACKAGE_FOLDER = Path(__file__).resolve().parents[1]
# What last bits depend on beside our own code; and what of that code cannot change a number.
_NUMERICS = ("numpy", "scipy", "pocl-binary-distribution")
_NO_NUMBERS = ("report", "cluster", "cli.py", "commands", "terminal.py", "__main__.py")


def collect(device: Device) -> dict[str, str]:
    """Return what identifies this machine and software, as short texts by name.

    Parameters
    ----------
    device : Device
        The device that runs the kernels.
    """
    return {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "wavequake": __version__,
        "code": code(),
        "git_commit": _own_commit(),
        "python": platform.python_version(),
        "packages": _packages(),
        "platform": platform.platform(),
        "cpu": cpu_model(),
        "blas": blas(),
        "opencl": opencl(device),
    }


@lru_cache(maxsize=1)
def _own_commit() -> str:
    return git_commit(_PACKAGE_FOLDER)  # once: what is loaded stays, and git takes longer than a small store


@lru_cache(maxsize=1)
def _packages() -> str:
    return ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)


def code() -> str:
    """Return what computes numbers here: Wavequake with a digest of its sources, libraries, plug-ins.

    Chunks of one store must agree in it, or their bits may differ.
    """
    return ", ".join([_own_code(), *(f"plug-in {plugin}" for plugin in loaded_plugins())])


@lru_cache(maxsize=1)
def _own_code() -> str:
    sources = source_digest(_PACKAGE_FOLDER, folder("kernels"), folder("firmware") / "core")
    parts = [f"wavequake {__version__} ({sources})"]
    parts += [f"{name} {_version(name)}" for name in _NUMERICS]
    return ", ".join([*parts, *blas_cores()])


def source_digest(package: Path, *others: Path) -> str:
    """Return a short digest of the sources that make numbers: Python of the package, kernels, firmware."""
    found = hashlib.blake2b(digest_size=6)
    for home, suffixes in ((package, (".py",)), *((other, (".cl", ".c", ".h")) for other in others)):
        names = [one for suffix in suffixes for one in glob(f"**/*{suffix}", root_dir=home, recursive=True)]
        for name in sorted(one.replace(os.sep, "/") for one in names):
            if name.split("/")[0] not in _NO_NUMBERS:
                found.update(f"{name}\0".encode() + (home / name).read_bytes())
    return found.hexdigest()


def blas_cores() -> list[str]:
    """Return the kinds of processor core that NumPy's BLAS computes for, which decide its last bits."""
    pools = [pool for pool in threadpool_info() if "numpy" in Path(pool["filepath"]).as_posix()]
    return sorted({str(pool["architecture"]) for pool in pools if pool.get("architecture")})


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"


def git_commit(folder: Path) -> str:
    """Return the commit of the checkout that tracks `folder`, "-dirty" if files differ; "" outside of one."""
    try:
        # An installed package may lie inside somebody else's repository: only tracked files count.
        tracked = _git(folder, "ls-files", "--error-unmatch", "__init__.py")
        commit = _git(folder, "rev-parse", "HEAD") if tracked else ""
        dirty = bool(commit) and bool(_git(folder, "status", "--porcelain", "--untracked-files=no"))
    except (OSError, subprocess.SubprocessError):
        return ""
    return f"{commit}-dirty" if dirty else commit


def _git(folder: Path, *words: str) -> str:
    done = subprocess.run(["git", *words], cwd=folder, capture_output=True, text=True, timeout=5, check=True)
    return done.stdout.strip()


def cpu_model() -> str:
    """Return the name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def blas() -> str:
    """Return name, version and core type of the loaded BLAS, which decide the last bits of a product."""
    found = [pool for pool in threadpool_info() if pool["user_api"] == "blas"]
    words = (
        f"{pool['internal_api']} {pool.get('version')} {pool.get('architecture', '')}".strip()
        for pool in found
    )
    return ", ".join(sorted(set(words)))


def opencl(device: Device) -> str:
    """Return the device with its driver's version; "" for NumPy."""
    if device.kind == "numpy":
        return ""
    handle = opencl_handle(device)
    return (
        f"{device.name} ({device.platform}, {handle.version.strip()}, driver {handle.driver_version.strip()})"
    )
