"""The folder names are the architecture: imports run one way."""

import ast
import re
from collections import Counter
from collections.abc import Callable, Collection
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "pipeline" / "wavequake"
PHYSICS = {"mechanics", "reduction", "optics", "imaging", "control"}
BASE = {"bundled", "errors", "files", "prepared", "registry", "tables", "user_files", "words", "posix"}

# What each package may import of ours, besides itself.
ALLOWED = {
    "errors": {"words"},
    "bundled": {"files"},
    "files": set(),
    "user_files": {"errors"},
    "words": set(),
    "memory": set(),
    "posix": {"errors"},
    "registry": {"errors"},
    "prepared": set(),
    "tables": set(),
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
    "viewer": BASE | PHYSICS | {"campaign", "chain", "drawing", "kernels", "report", "workflows"},
    "notebook": BASE | {"drawing", "optics"},
    "plot": BASE | {"drawing"},
    "doors": BASE
    | PHYSICS
    | {"campaign", "drawing", "firmware", "kernels", "notebook", "report", "workflows"},
    "terminal": {"words"},
    "commands": BASE
    | {"campaign", "control", "drawing", "firmware", "kernels", "optics", "report", "viewer", "workflows"}
    | {"terminal"},
    "cli": BASE
    | PHYSICS
    | {"campaign", "chain", "commands", "kernels", "workflows", "report", "cluster", "terminal"},
    "__main__": {"cli", "terminal"},
}
# The package's front door imports lazily, for users; provenance may ask it for the version.
FRONT_DOOR = "__init__"
NOT_IN_PHYSICS = {"dask", "distributed", "zarr", "xarray"}

MODULES = sorted(PACKAGE.rglob("*.py"))


@cache
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


def offenders(wrong: Callable[[Path], Collection[str]]) -> str:
    """Return every module of which something is wrong, and what, in lines."""
    found = ((path, wrong(path)) for path in MODULES)
    return "\n".join(
        f"{path.relative_to(PACKAGE)}: {', '.join(sorted(what))}" for path, what in found if what
    )


def test_imports_run_one_way():
    def forbidden(path):
        ours = {name.split(".")[1] for name in imports_of(path) if name.startswith("wavequake.")}
        return (
            ours - {"__version__", "BEGUN", home(path)} - ALLOWED[home(path)]
            if home(path) != FRONT_DOOR
            else ()
        )

    assert not (said := offenders(forbidden)), said


def test_no_module_imports_in_a_circle():
    """Nor by imports inside functions."""
    names = {".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts): path for path in MODULES}
    imports = {name: imports_of(path) & names.keys() for name, path in names.items()}
    tuple(TopologicalSorter(imports).static_order())  # raises CycleError, which names the circle


def test_no_bare_folder_imports():
    bare = set(ALLOWED) - {"__main__"} | {"pipeline"}
    assert not (said := offenders(lambda path: bare & {name.split(".")[0] for name in imports_of(path)})), (
        said
    )


def test_physics_knows_no_dask_and_no_store():
    def forbidden(path):
        physics = home(path) in PHYSICS | {"kernels"}
        return NOT_IN_PHYSICS & {name.split(".")[0] for name in imports_of(path)} if physics else ()

    assert not (said := offenders(forbidden)), said


def test_rooms_are_small_enough_to_be_seen_at_once():
    rooms = Counter(path.parent.relative_to(PACKAGE).as_posix() for path in MODULES)
    assert {room for room, modules in rooms.items() if modules > 21} == set()


def test_what_is_kept_is_prepared_on_one_thread_of_blas():
    """A cache of functools may be filled with all threads: bits of a case would depend on who asked."""

    def unguarded(path):
        rooms = PHYSICS | {"chain", "workflows"}
        return imports_of(path) & {"functools.lru_cache", "functools.cache"} if home(path) in rooms else ()

    assert not (said := offenders(unguarded)), f"use wavequake.prepared.prepared in\n{said}"


def test_every_package_has_its_rule():
    assert {home(path) for path in MODULES} - {FRONT_DOOR} - set(ALLOWED) == set()


def test_files_are_readable_in_one_sitting():
    lines = {path: len(path.read_text().splitlines()) for path in MODULES}
    assert not (said := offenders(lambda path: [f"{lines[path]} lines"] if lines[path] > 400 else ())), said


def test_test_files_have_names_of_their_own():
    names = [path.name for path in Path(__file__).parent.rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


def test_the_fast_tests_are_there_and_reach_every_room():
    tests = Path(__file__).parent
    found = re.search(
        r"^FAST := (.*?[^\\\\])$", (tests.parent / "Makefile").read_text(), re.MULTILINE | re.DOTALL
    )
    files = [tests / name for name in found[1].replace("\\\n", " ").split()]
    assert not [path for path in files if not path.is_file()]
    rooms = {path.parent for path in tests.rglob("test_*.py")}
    assert not (missing := sorted(path.name for path in rooms - {path.parent for path in files})), missing
