"""Small stores of every study kind, made once for all processes of a run."""

import fcntl
import shutil

import pytest
from small_kinds import small_study

from wavequake.workflows.run import run_study
from wavequake.workflows.study import study_with


@pytest.fixture(scope="session")
def kept_stores(tmp_path_factory, shared_folder):
    """Return the small study of a kind, and its store under some keys of `store`, as functions.

    Whichever process asks first runs the campaign; each has a copy of its own, into which it may report.
    """
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
