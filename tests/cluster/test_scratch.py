"""Nobody else can write where Dask's processes look for modules: what lies there runs as the user."""

import importlib.util
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from multiprocessing.util import get_temp_dir
from pathlib import Path

import pytest
from distributed import LocalCluster

from wavequake.cluster.local import local_cluster
from wavequake.cluster.scratch import scratch_folder, scratch_lines


@pytest.fixture
def shared(monkeypatch):
    """The temporary folder of a machine, where somebody else made the folder that Dask shares by default.

    Sockets of workers lie where they lay before, for as long as this process of tests lives.
    """
    get_temp_dir()
    folder = Path(tempfile.mkdtemp(prefix="shared-"))
    planted = folder / "dask-scratch-space"
    planted.mkdir(parents=True)
    (planted / "planted.py").touch()
    for each in (folder, planted):
        each.chmod(0o1777)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def finds_what_was_planted():
    importlib.invalidate_caches()
    return importlib.util.find_spec("planted") is not None


def others_may_write(folder):
    """Whether somebody else may put anything in a folder, or another one in its place."""
    chain = [path.stat() for path in (folder, *folder.parents)]
    own = [one.st_uid in (0, os.getuid()) for one in chain]
    closed = [not one.st_mode & 0o022 for one in chain]
    sticky = [bool(one.st_mode & stat.S_ISVTX) for one in chain[1:]]
    return not (all(own) and closed[0] and all(a or b for a, b in zip(closed[1:], sticky, strict=True)))


def temporary_paths(shared):
    return [path for path in map(Path, sys.path) if path.is_relative_to(shared)]


def test_neither_workers_nor_driver_import_what_somebody_planted(shared):
    with local_cluster(1) as client:
        assert not finds_what_was_planted()
        assert list(client.run(finds_what_was_planted).values()) == [False]
        here, (there,) = temporary_paths(shared), client.run(temporary_paths, shared).values()
        assert here
        assert there
        assert not [path for path in (*here, *there) if others_may_write(path)]
    assert not temporary_paths(shared)


def test_the_attack_succeeds_where_dask_chooses_its_folder(shared):
    with LocalCluster(1, threads_per_worker=1, host="127.0.0.1", dashboard_address="127.0.0.1:0"):
        assert finds_what_was_planted()
        assert any(map(others_may_write, temporary_paths(shared)))


def test_a_folder_is_the_same_for_all_runs(shared):
    found = Path(scratch_folder())
    assert found.parent == shared
    assert stat.S_IMODE(found.stat().st_mode) == 0o700
    assert scratch_folder() == str(found)


@pytest.mark.parametrize("kind", ["open", "group", "link", "file", "somebody's"])
def test_where_somebody_was_before_another_folder_is_made(shared, monkeypatch, kind):
    user = os.getuid() + (kind == "somebody's")
    monkeypatch.setattr(os, "getuid", lambda: user)
    place = shared / f"wavequake-{user}"
    if kind == "link":
        (shared / "elsewhere").mkdir(mode=0o700)
        place.symlink_to(shared / "elsewhere")
    elif kind == "file":
        place.touch(mode=0o600)
    else:
        place.mkdir()
        place.chmod({"open": 0o777, "group": 0o770, "somebody's": 0o700}[kind])
    found = Path(scratch_folder())
    assert found != place
    assert found.is_dir()
    assert stat.S_IMODE(found.stat().st_mode) == 0o700


@pytest.mark.parametrize("named", [True, False])
def test_a_job_makes_its_folder_and_takes_it_away(tmp_path, named):
    parent = tmp_path / "local"
    show = ['stat -c "%a %n" "$DASK_TEMPORARY_DIRECTORY"']
    lines = scratch_lines(str(parent) if named else None) + show
    where = {**os.environ, "TMPDIR": str(parent)}
    done = subprocess.run(["sh", "-c", "\n".join(lines)], capture_output=True, text=True, env=where)
    mode, folder = done.stdout.split()
    assert mode == "700"
    assert Path(folder).parent == parent
    assert list(parent.iterdir()) == []


def test_a_job_without_such_a_folder_ends(tmp_path):
    (tmp_path / "file").touch()
    lines = [*scratch_lines(str(tmp_path / "file")), "echo goes on"]
    done = subprocess.run(["sh", "-c", "\n".join(lines)], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stdout == ""
