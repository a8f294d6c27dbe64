"""Settings that every test shares."""

import fcntl
import gc
import os
import shutil
import signal
import sys
from contextlib import contextmanager, nullcontext, suppress
from functools import lru_cache

import pytest
import typer.main
from hypothesis import settings

# One thread per process, as in a worker, and examples that are the same in every run.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")
os.environ.setdefault("POCL_MAX_PTHREAD_COUNT", "1")
os.environ.pop("COLUMNS", None)  # tables are as wide as it says, here as wide as they are in a pipe

import wavequake.terminal  # noqa: E402  what it prints on is made now, whatever tests do to the output

# A shell ignores Ctrl-C for what it runs in the background, and children would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    with suppress(ValueError):  # outside the main thread
        signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("ci", max_examples=25, deadline=None, derandomize=True, database=None)
settings.load_profile("ci")

# Files that take half a minute and more, the longest first: the last file of a run shall be a short one.
LONGEST = (
    "test_recorded_numbers.py",
    "test_docs.py",
    "test_faults.py",
    "test_report_page.py",
    "test_object_stores.py",
    "test_kept_reports.py",
    "test_suspects.py",
    "test_telemetry_lines.py",
    "test_large_stores.py",
    "test_first_rays.py",
    "test_kept_images.py",
    "test_sequential_contract.py",
    "test_mirror_exposure.py",
)
# Where tests look at the figures of pages, and where they only want them drawn.
DRAWN = (
    "viewer",
    "drawing",
    "test_figures.py",
    "test_vibration.py",
    "test_errors.py",
    "test_telescope_loop.py",
)
CROWDED = ("report", "test_docs.py")


def pytest_collection_modifyitems(items):
    """Begin with the longest files, where files are dealt to processes in their order."""
    places = {name: place for place, name in enumerate(LONGEST)}
    items.sort(key=lambda item: places.get(item.path.name, len(LONGEST)))


def pytest_collection_finish():
    """Look for garbage in what tests make, not again and again in all of them and their modules."""
    gc.collect()
    gc.freeze()


def _blank(figure, salt):
    """Leave a figure undrawn: drawing takes most of a report's time."""
    return "<svg></svg>"


def _crowded(figure, salt):
    """Draw a figure without seeking room for what it says, which takes half of the time."""
    from wavequake.drawing import style

    figure.set_layout_engine("none")
    return style.svg_text(figure, salt)


def _words(figure, salt):
    """Write what a figure says, without drawing it."""
    from matplotlib.text import Text

    return f"<svg>{' '.join(one.get_text() for one in figure.findobj(Text))}</svg>"


@contextmanager
def _figures(drawn_by):
    """Have the figures of pages drawn otherwise."""
    from wavequake.report import page  # after the threads of NumPy are set

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "svg_text", drawn_by)
        yield


@pytest.fixture(scope="module", autouse=True)
def _drawn_where_figures_are_looked_at(request):
    names = {request.path.parent.name, request.path.name}
    with nullcontext() if names & {*DRAWN} else _figures(_crowded if names & {*CROWDED} else _blank):
        yield


@pytest.fixture
def undrawn():
    """Leave figures undrawn in one test of a file that draws them."""
    with _figures(_blank):
        yield


@pytest.fixture
def lettered():
    """Have figures say on pages what is written in them, in one test of a file that leaves them undrawn."""
    with _figures(_words):
        yield


@pytest.fixture
def drawn():
    """Draw figures in one test of a file that leaves them undrawn; those in a browser are looked at."""
    with _figures(_crowded):
        yield


@pytest.fixture(scope="session", autouse=True)
def _campaigns_that_name_no_place_are_serial():
    """Tests of workers ask for them; processes of a campaign's own would take seconds to start."""
    from wavequake.workflows import run

    decide = run._why_serial
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "_why_serial", lambda study, path, workers: decide(study, path, workers or 1))
        yield


@pytest.fixture(scope="session", autouse=True)
def _nobody_pulls_the_plug():
    """Files of tests need not reach the disk, for which each campaign would wait longer than it computes.

    Processes that are killed lose nothing by that; who asks for it is told what is no open file, as always.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: os.fstat(handle) and None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _the_command_line_is_built_once():
    """All commands with their options take 60 ms, as long as many a test of one of them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(typer.main, "get_command", lru_cache(maxsize=1)(typer.main.get_command))
        yield


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory):
    """Return a folder that all processes of a run share."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "shared"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="module")
def mirror_models(shared_folder):
    """Keep built mirrors out of the user's cache, in one folder of the whole run."""
    from wavequake.workflows.mirrors import model_store

    with pytest.MonkeyPatch.context() as patch:
        folder = shared_folder / "mirror-models"
        patch.setattr(model_store, "model_folder", lambda: folder)
        yield


@pytest.fixture(scope="session")
def kept_stores(tmp_path_factory, shared_folder):
    """Return the small study of a kind, and its store under some keys of `store`, as functions.

    Whichever process asks first runs the campaign; each has a copy of its own, into which it may report.
    """
    from small_kinds import small_study  # after the threads of NumPy are set

    from wavequake.workflows.run import run_study
    from wavequake.workflows.study import study_with

    folder, shared = tmp_path_factory.mktemp("kept"), shared_folder / "kept-stores"
    shared.mkdir(exist_ok=True)

    def study_of(name):
        return small_study(name, folder)

    def store_of(name, **keys):
        label = "-".join([name, *map(str, keys.values())])
        with (shared / f"{label}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (shared / label).exists():
                chosen = {f"store.{key}": value for key, value in keys.items()}
                run_study(study_with(study_of(name), chosen), shared / f"{label}.part", on="serial")
                (shared / f"{label}.part").rename(shared / label)
        if not (folder / label).exists():
            shutil.copytree(shared / label, folder / label)
        return folder / label

    return study_of, store_of


@pytest.fixture
def wavequake(monkeypatch, capsys):
    """Run the command line in this process; give (exit code, standard output, standard error)."""
    from wavequake import cli  # after the threads of NumPy are set

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["wavequake", *map(str, words)])
        try:
            cli.main()
            code = 0
        except SystemExit as end:
            code = end.code or 0
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run
