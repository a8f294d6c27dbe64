import subprocess

import numpy as np

import wavequake
from wavequake.campaign import provenance
from wavequake.kernels.device.devices import NUMPY, choose_device, list_devices


def test_provenance_names_software_and_machine():
    found = provenance.collect(NUMPY)
    assert all(isinstance(value, str) for value in found.values())
    assert "numpy 2" in found["packages"]
    assert "blas" in found["blas"].lower()
    assert found["cpu"]
    assert found["opencl"] == ""


def test_provenance_names_the_opencl_driver():
    device = choose_device("auto") if len(list_devices()) > 1 else NUMPY
    assert device.name in provenance.collect(device)["opencl"] or device is NUMPY


def test_commit_is_that_of_the_checkout_that_tracks_the_package(tmp_path):
    def git(*words):
        identity = ("-c", "user.name=a", "-c", "user.email=a@b")
        subprocess.run(["git", *identity, *words], cwd=tmp_path, check=True, capture_output=True)

    assert provenance.git_commit(tmp_path) == ""
    git("init")
    (tmp_path / "__init__.py").write_text("")
    assert provenance.git_commit(tmp_path) == ""  # installed inside somebody else's repository
    git("add", "__init__.py")
    git("commit", "-m", "a")
    commit = provenance.git_commit(tmp_path)
    assert len(commit) == 40
    (tmp_path / "__init__.py").write_text("1")
    assert provenance.git_commit(tmp_path) == f"{commit}-dirty"


def test_the_digest_of_the_sources_sees_what_makes_numbers(tmp_path):
    package = ("optics/trace.py", "report/page.py", "cli.py")
    for name in (*package, "kernels/trace.cl", "kernels/notes.txt", "core/control.c"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("a")

    def digest():
        return provenance.source_digest(tmp_path, tmp_path / "kernels", tmp_path / "core")

    before = digest()
    for name in ("report/page.py", "cli.py", "kernels/notes.txt"):
        (tmp_path / name).write_text("b")
    assert digest() == before
    for name in ("optics/trace.py", "kernels/trace.cl", "core/control.c"):
        (tmp_path / name).write_text("b")
        assert digest() != before
        (tmp_path / name).write_text("a")
    assert digest() == before
    (tmp_path / "optics/trace.py").rename(tmp_path / "optics/other.py")
    assert digest() != before


def test_the_code_names_versions_and_the_kind_of_core():
    assert provenance.code().startswith(f"wavequake {wavequake.__version__} (")
    assert f"numpy {np.__version__}" in provenance.code()
    assert provenance.code() == provenance.code()
