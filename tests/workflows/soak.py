"""Kill a campaign at random points, again and again, and see whether it loses or changes anything.

Three kinds of death, all by SIGKILL: of the whole driver with its scheduler at a random moment, of one of its
workers, and of a driver in the very middle of a write (before, within or after a file, a rename or a record).
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time

import psutil
import toy

from wavequake.workflows.store import open_store
from wavequake.workflows.verify import verify_store

CHUNK, MORE = 5, 60
SLOW = {"sleep_s": 0.004}

# A serial driver that kills itself at its n-th touch of the disk.
WRITER = """
import os, pathlib, signal, sys
import toy
from wavequake.workflows import arrays, journal
path, cases, left = sys.argv[1], int(sys.argv[2]), [int(sys.argv[3])]

def touch():
    left[0] -= 1
    if not left[0]:
        os.kill(os.getpid(), signal.SIGKILL)

put, write, sync, rename = arrays.DurableStore.set, os.write, os.fsync, pathlib.Path.replace

async def set_and_die(self, key, value):
    touch()
    await put(self, key, value)
    touch()

def write_and_die(handle, content):
    touch()
    half = len(content) // 2
    done = write(handle, content[:half])
    touch()
    return done + write(handle, content[half:])

def sync_and_die(handle):
    touch()
    sync(handle)

def rename_and_die(self, target):
    touch()
    return rename(self, target)

arrays.DurableStore.set, os.fsync, pathlib.Path.replace = set_and_die, sync_and_die, rename_and_die
journal.os = type(sys)("os")
journal.os.__dict__.update(os.__dict__, write=write_and_die, fsync=sync_and_die)
toy.run(path, SLOW, cases=cases, chunk=CHUNK)
""".replace("CHUNK", str(CHUNK)).replace("SLOW", repr(SLOW))


def soak(folder, kills, seed=1):
    """Kill campaigns that grow as they go, `kills` times in all; return counts of the deaths by kind."""
    dice = random.Random(seed)
    counts = {"driver": 0, "worker": 0, "write": 0}
    while sum(counts.values()) < kills:
        _round(folder / f"round-{sum(counts.values())}", min(20, kills - sum(counts.values())), dice, counts)
    return counts


def _round(folder, kills, dice, counts):
    """Kill one campaign `kills` times, complete it, and compare it with one that was left in peace."""
    path, cases, before = folder / "s", MORE, sum(counts.values())
    folder.mkdir()
    while sum(counts.values()) < before + kills:
        kind = dice.choices(["write", "worker", "driver"], [5, 3, 2])[0]
        killed = _in_a_write(path, cases, dice) if kind == "write" else _at_random(path, cases, kind, dice)
        counts[kind] += killed
        if (path / "manifest.json").exists():
            report = verify_store(path)
            assert not report.damaged, report.lines()
            cases += MORE if report.ok else 0  # it came to its end: go on with more
    toy.run(path, SLOW, cases=cases, chunk=CHUNK)
    toy.run(folder / "serial", SLOW, cases=cases, chunk=CHUNK)
    report = verify_store(path)
    assert report.ok, report.lines()
    assert report.extra == ()
    assert toy.digests(path) == toy.digests(folder / "serial")
    stored, serial = (open_store(one).load().drop_attrs() for one in (path, folder / "serial"))
    assert stored.identical(serial)
    shutil.rmtree(folder)


def _in_a_write(path, cases, dice):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", WRITER, str(path), str(cases), str(dice.randint(1, 250))]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode in (0, -signal.SIGKILL), done.stderr
    return done.returncode != 0


def _at_random(path, cases, kind, dice):
    before = toy.records(path)
    driver = toy.driver(path, SLOW, cases=cases, chunk=CHUNK, on="local", workers=2)
    try:
        if kind == "driver" and dice.random() < 0.3:
            time.sleep(dice.uniform(0.0, 2.0))  # while it starts
        else:
            while toy.records(path) == before and driver.poll() is None:
                time.sleep(0.01)
            time.sleep(dice.uniform(0.0, 0.3))
        if driver.poll() is not None:
            return False
        if kind == "driver":
            driver.kill()
            return True
        workers = [child for child in psutil.Process(driver.pid).children() if _is_worker(child)]
        if not workers:
            return False
        dice.choice(workers).kill()
        said, complained = driver.communicate(timeout=120)
        assert driver.returncode == 0, said + complained
        return True
    finally:
        driver.kill()
        driver.communicate()


def _is_worker(process):
    try:
        return "spawn_main" in " ".join(process.cmdline())
    except psutil.Error:
        return False
