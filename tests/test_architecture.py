"""The folder names are the architecture: imports run one way."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "pipeline" / "wavequake"
PHYSICS = {"mechanics", "reduction", "optics", "imaging", "control"}
BASE = {"errors", "files", "prepared", "registry", "user_files", "words"}

# What each package may import of ours, besides itself.
ALLOWED = {
    "errors": set(),
    "files": set(),
    "user_files": {"errors"},
    "words": set(),
    "memory": set(),
    "registry": {"errors"},
    "prepared": set(),
    "kernels": BASE,
    "mechanics": BASE | {"kernels"},
    "reduction": BASE | {"kernels", "mechanics"},
    "optics": BASE | {"kernels"},
    "imaging": BASE | {"kernels", "optics"},
    "control": BASE | {"kernels"},
    "firmware": BASE | {"control"},
    "cluster": BASE,
    "campaign": BASE | {"cluster", "kernels", "memory"},
    "chain": BASE | PHYSICS | {"campaign", "kernels"},
    "workflows": BASE | PHYSICS | {"campaign", "chain", "kernels", "firmware"},
    "drawing": BASE | PHYSICS | {"campaign", "chain", "kernels", "workflows"},
    "report": BASE | PHYSICS | {"campaign", "chain", "drawing", "kernels", "workflows"},
    "notebook": BASE | {"drawing"},
    "plot": BASE | {"drawing"},
    "doors": BASE | PHYSICS | {"campaign", "notebook", "report", "workflows"},
    "terminal": set(),
    "cli_firmware": BASE | {"campaign", "control", "firmware", "workflows", "terminal"},
    "cli_sensitivity": BASE | {"campaign", "kernels", "workflows", "report", "terminal"},
    "cli_statistics": BASE | {"campaign", "workflows", "report", "terminal"},
    "cli_pictures": BASE | {"drawing", "workflows", "terminal"},
    "cli": BASE
    | PHYSICS
    | {"campaign", "chain", "kernels", "workflows", "report", "cluster", "terminal"}
    | {"cli_firmware", "cli_pictures", "cli_sensitivity", "cli_statistics"},
    "__main__": {"cli"},
}
# The package's front door imports lazily, for users; provenance may ask it for the version.
FRONT_DOOR = "__init__"
NOT_IN_PHYSICS = {"dask", "distributed", "zarr", "xarray"}

MODULES = sorted(PACKAGE.rglob("*.py"))


def imports_of(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module or "")
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def home(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_run_one_way(path):
    if home(path) == FRONT_DOOR:
        return
    ours = {name.split(".")[1] for name in imports_of(path) if name.startswith("wavequake.")}
    ours -= {"__version__", home(path)}
    assert ours <= ALLOWED[home(path)]


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_no_bare_folder_imports(path):
    tops = {name.split(".")[0] for name in imports_of(path)}
    assert not tops & (set(ALLOWED) - {"__main__"} | {"pipeline"})


@pytest.mark.parametrize(
    "path", [p for p in MODULES if home(p) in PHYSICS | {"kernels"}], ids=lambda path: path.name
)
def test_physics_knows_no_dask_and_no_store(path):
    assert not {name.split(".")[0] for name in imports_of(path)} & NOT_IN_PHYSICS


def test_rooms_are_small_enough_to_be_seen_at_once():
    """The flat folders that are left are named; no new one joins them."""
    rooms = Counter(path.parent.relative_to(PACKAGE).as_posix() for path in MODULES)
    assert {room for room, modules in rooms.items() if modules > 21} <= {"report"}


def test_what_is_kept_is_prepared_on_one_thread_of_blas():
    """A cache of functools may be filled with all threads: bits of a case would depend on who asked."""
    found = [
        str(path.relative_to(PACKAGE))
        for path in MODULES
        if home(path) in PHYSICS | {"chain", "workflows"}
        and imports_of(path) & {"functools", "functools.lru_cache", "functools.cache"}
        and re.search(r"\b(functools\.cache|(functools\.)?lru_cache|import .*\bcache)\b", path.read_text())
    ]
    assert not found, f"use wavequake.prepared.prepared in {', '.join(found)}"


def test_every_package_has_its_rule():
    assert {home(path) for path in MODULES} - {FRONT_DOOR} <= set(ALLOWED)


def test_files_are_readable_in_one_sitting():
    assert not [str(path) for path in MODULES if len(path.read_text().splitlines()) > 400]


def test_test_files_have_names_of_their_own():
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))
