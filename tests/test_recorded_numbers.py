"""Every bundled study gives the numbers that it gave when it was recorded."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from tests import recorded

from wavequake.errors import UserError
from wavequake.firmware.build import BOARDS, compiler_of
from wavequake.workflows.study import bundled_studies


def comparable():
    """Names of the recordings that can be made here: firmware needs a compiler."""
    try:
        compiler_of(BOARDS["host"])
    except UserError:
        return [name for name, small in recorded.RECORDED.items() if small.study != "lens-firmware"]
    return list(recorded.RECORDED)


needs_the_same_libraries = pytest.mark.skipif(
    recorded.made_with() != recorded.MADE_WITH, reason=f"recordings are of {recorded.MADE_WITH}"
)


def compare(*names):
    """Return what the recordings say of two processes with two threads of BLAS, line by line."""
    if " avx2 " not in Path("/proc/cpuinfo").read_text():
        pytest.skip("recordings are made with the kernels of AVX2")
    with ThreadPoolExecutor() as pool:  # `make test-fast` has little else to do meanwhile
        run = partial(recorded.run_alike, "--compare", threads=2)
        halves = [one.result() for one in [pool.submit(run, *names[half::2]) for half in (0, 1)]]
    assert not any(done.stderr for done in halves)
    lines = [line for done in halves for line in done.stdout.splitlines()]
    assert len(lines) == len(names)
    return lines


def changed(lines):
    return "\n".join(line for line in lines if ": agrees " not in line)


@pytest.fixture(scope="module")
def compared():
    """The recordings that have the names of bundled studies, one of each."""
    return compare(*(name for name in comparable() if name in bundled_studies()))


@pytest.mark.slow
@needs_the_same_libraries
def test_every_bundled_study_gives_the_recorded_numbers(compared):
    assert len(compared) >= len(bundled_studies()) - 1  # one needs a compiler
    assert not (said := changed(compared)), said


@pytest.mark.slow
@needs_the_same_libraries
def test_variants_of_studies_give_the_recorded_numbers():
    """Other keys of the same studies, which `make test-fast` leaves out."""
    lines = compare(*(name for name in comparable() if name not in bundled_studies()))
    assert not (said := changed(lines)), said


@pytest.mark.slow
def test_bits_do_not_depend_on_threads_and_place(compared):
    """With one thread in the client, and halves by two workers that have one each."""
    names = [name for name in comparable() if name in bundled_studies()]
    done = recorded.run_alike("--compare", "--workers", *names)
    assert len(names) >= len(bundled_studies()) - 1, done.stderr
    assert sorted(done.stdout.splitlines()) == sorted(compared)


def test_every_bundled_study_is_recorded_and_small():
    assert {small.study for small in recorded.RECORDED.values()} == set(bundled_studies())
    files = list(recorded.FOLDER.glob("*"))
    assert {path.name for path in files} == {f"{name}.npz" for name in recorded.RECORDED}
    assert sum(path.stat().st_size for path in files) < 1.5e6


@pytest.mark.parametrize("shape", [(40,), (2, 2500)])
def test_a_changed_number_is_seen(shape):
    """Whether kept whole or condensed, no number may move by 1e-10 of the largest; nor become unknown."""
    values = np.random.default_rng(5).standard_normal(shape)
    kept = recorded.condense(values)
    for place in list(np.ndindex(*shape))[::11]:
        for change in (1e-10 * np.abs(values).max(), np.nan):
            changed = values.copy()
            changed[place] += change
            now = recorded.condense(changed)
            assert max(recorded.difference(kept, key, now[key]) for key in kept) > recorded.AGREED, place
