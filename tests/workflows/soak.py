"""Kill a campaign at random points, again and again, and see whether it loses or changes anything.

Three kinds of death, all by SIGKILL: of the whole driver with its scheduler at a random moment, of one of its
workers, and of a driver in the very middle of a write (before, within or after a file, a rename or a record).
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import psutil
import toy

from wavequake.campaign.store.store import open_store
from wavequake.campaign.store.verify import verify_store

CHUNK, MORE = 5, 60
SLOW = {"sleep_s": 0.004}

# Serial drivers that kill themselves at their n-th touch of the disk: children of one process, which has
# loaded everything.
WRITER = """
import json, os, pathlib, signal, sys
import toy, wavequake.campaign.engine.driver
from wavequake.campaign.store import arrays
from wavequake.campaign.store import journal
left = [0]

def touch():
    left[0] -= 1
    if not left[0]:
        os.kill(os.getpid(), signal.SIGKILL)

put, write, sync, rename = arrays._put, os.write, os.fsync, pathlib.Path.replace

def put_and_die(path, parts):
    touch()
    put(path, parts)
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

arrays._put, os.fsync, pathlib.Path.replace = put_and_die, sync_and_die, rename_and_die
journal.os = type(sys)("os")
journal.os.__dict__.update(os.__dict__, write=write_and_die, fsync=sync_and_die)
for line in sys.stdin:
    path, cases, left[0] = json.loads(line)
    child = os.fork()
    if not child:
        try:
            toy.run(path, SLOW, cases=cases, chunk=CHUNK)
            os._exit(0)
        finally:
            sys.excepthook(*sys.exc_info())
            os._exit(1)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
""".replace("CHUNK", str(CHUNK)).replace("SLOW", repr(SLOW))


def soak(folder, kills, seed=1):
    """Kill campaigns that grow as they go, `kills` times in all or a few more; count the deaths by kind."""
    rounds = [min(20, kills - first) for first in range(0, kills, 20)]
    with ThreadPoolExecutor(2) as both:
        counts = both.map(
            lambda index: _round(folder / f"round-{index}", rounds[index], random.Random(seed + index)),
            range(len(rounds)),
        )
        return sum(counts, Counter())


def _round(folder, kills, dice):
    """Kill one campaign `kills` times, complete it, and compare it with one that was left in peace."""
    path, cases, counts = folder / "s", MORE, Counter()
    folder.mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", WRITER], env=environment, text=True, **pipes) as writer:
        while counts.total() < kills:
            kind = dice.choices(["write", "worker", "driver"], [8, 1, 2])[0]
            if kind == "write":
                counts[kind] += _in_a_write(writer, path, cases, dice)
            else:
                counts[kind] += _at_random(path, cases, kind, dice)
            if (path / "manifest.json").exists():
                report = verify_store(path)
                assert not report.damaged, report.lines()
                cases += MORE if report.ok else 0  # it came to its end: go on with more
        _, complained = writer.communicate()
        assert complained == ""
    toy.run(path, SLOW, cases=cases, chunk=CHUNK)
    toy.run(folder / "serial", SLOW, cases=cases, chunk=CHUNK)
    report = verify_store(path)
    assert report.ok, report.lines()
    assert report.extra == ()
    assert toy.digests(path) == toy.digests(folder / "serial")
    stored, serial = (open_store(one).load().drop_attrs() for one in (path, folder / "serial"))
    assert stored.identical(serial)
    shutil.rmtree(folder)
    return counts


def _in_a_write(writer, path, cases, dice):
    print(json.dumps([str(path), cases, dice.randint(1, 250)]), file=writer.stdin, flush=True)
    code = int(writer.stdout.readline())
    assert code in (0, -signal.SIGKILL), code
    return code != 0


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
        if kind == "driver":
            alive = driver.poll() is None
            driver.kill()
            return alive
        killed = 0
        for _ in range(4):  # the nanny starts them again
            workers = _workers(driver.pid)
            if workers and driver.poll() is None:
                dice.choice(workers).kill()
                killed += 1
            time.sleep(dice.uniform(0.0, 0.5))
        said, complained = driver.communicate(timeout=120)
        assert driver.returncode == 0, said + complained
        return killed
    finally:
        driver.kill()
        driver.communicate()


def _workers(pid):
    """Return the worker processes of a run, if it has got that far."""
    try:
        servers = [one for one in psutil.Process(pid).children() if "forkserver" in " ".join(one.cmdline())]
        return [worker for one in servers for worker in one.children()]
    except psutil.Error:
        return []
