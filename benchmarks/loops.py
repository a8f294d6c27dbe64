"""How fast loops run in time: simulated seconds per second of one core, over channels and cases at once.

Actuators of second order, one frame of latency plus a quarter, 1000 frames per second, a dense sensor and a
dense controller: 2 channels (tip and tilt), 104 (a mirror of 105 Zernike terms) and 492 (the segments of the
TMT). Then all of that telescope together: 1476 actuators of which each moves one mode or four (5904), held by
2772 edge sensors at 50 Hz, a tip-tilt loop at 1 kHz, and a structure of 30 or 300 modes that both push and
see. Beside both the bounds of the same machine in the same run: multiply-adds of what must be multiplied at
the rate of a large matrix product, and bytes that must be read and written at the rate of a copy. One thread;
medians. Last, what is published of other programs.
"""

import time
from functools import partial
from itertools import product

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.linalg import block_diag
from threadpoolctl import threadpool_limits

from benchmarks._verdict import verdict
from benchmarks._warm import warm
from wavequake.control.sampled.channel import Dynamics, Timing, in_series, recoil, second_order
from wavequake.control.sampled.filters import integrator
from wavequake.control.sampled.regulator import shared_filter
from wavequake.control.sampled.run import (
    ACT,
    LOOK,
    READ,
    Actuator,
    Loop,
    Schedule,
    frame_count,
    run,
    schedule,
)

Array = NDArray[np.float64]

FRAME, FRAMES, REPEATS = 1e-3, 50, 5
CHANNELS, CASES = (2, 104, 492), (1, 4, 16, 64)
_SIZE, _COPIED = 1024, 1 << 24
SEGMENTS, EDGES, TOGETHER, SECONDS = 1476, 2772, (1, 4, 16), 0.5
# Of what an actuator moves, in modes behind its servo; with the servo's own, one and four modes.
SHARES: tuple[list[float], ...] = ([], [0.9, 0.07, 0.03])
STRUCTURES = (30, 300)
PEERS = """Of other programs:
- MAOS takes 0.11 s for a time step of the adaptive optics of the TMT (NFIRAOS) on two GPUs (GTX 580),
  turbulence and images of its wavefront sensors included, a structure not (L. Wang and B. Ellerbroek 2012,
  Computer simulations and real-time control of ELT AO systems using graphical processing units, abstract).
- GMT's integrated model steps modes by exponentials at 1 kHz, as here (docs.rs/gmt_dos-clients_fem); we found
  no times of it."""


def loop_of(channels: int) -> tuple[Loop, Schedule]:
    """Return a stable loop of so many channels, and its events."""
    rng = np.random.default_rng(channels)
    sees = np.eye(channels) + 0.2 / np.sqrt(channels) * rng.standard_normal((channels, channels))
    free = np.full(channels, np.inf)
    actuator = Actuator(second_order(300.0, 0.7), free, np.inf, np.full(channels, np.nan))
    timing = Timing(FRAME, FRAME, 1, 1.25 * FRAME)
    regulator = shared_filter(np.linalg.inv(sees), integrator(0.2))
    return Loop(timing, regulator, actuator, sees), schedule([timing], np.array([FRAMES * FRAME]))


def telescope(shares: list[float], structure: int) -> tuple[list[Loop], Schedule, tuple[Dynamics, ...]]:
    """Return the loops of a whole telescope, their events and how its structure answers.

    Behind its servo each actuator moves modes that share what it does.
    """
    rng = np.random.default_rng(0)
    servo = second_order(20.0, 0.5)
    if shares:
        servo = in_series(servo, _beside([40.0, 90.0, 120.0], shares))
    parts = []
    for channels, readings, dynamics, frame in (
        (SEGMENTS, EDGES, servo, 0.02),
        (2, 2, second_order(300.0, 0.7), FRAME),
    ):
        timing = Timing(frame, frame, 1, 0.25 * frame)
        sees = rng.standard_normal((readings, SEGMENTS + 2 + structure)) / np.sqrt(SEGMENTS)
        own = slice(0, SEGMENTS) if channels == SEGMENTS else slice(SEGMENTS, SEGMENTS + 2)
        regulator = shared_filter(np.linalg.pinv(sees[:, own]), integrator(0.05))
        moved = Actuator(dynamics, np.full(channels, np.inf), np.inf, np.full(channels, np.nan))
        drives = 1e-3 * rng.standard_normal((structure, channels)) / np.sqrt(channels)
        parts.append(Loop(timing, regulator, moved, sees, drives=drives))
    hertz = np.linspace(6.0, 120.0, structure)
    events = schedule([one.timing for one in parts], np.array([SECONDS]))
    return parts, events, tuple(recoil(float(one), 0.01) for one in hertz)


def least(loops: list[Loop], events: Schedule, structure: int, cases: int) -> tuple[float, float]:
    """Return multiply-adds, and bytes read and written, without which loops of one sensor each cannot do.

    Matrices are read once each time that they multiply a batch; of states and integrals every step of a
    channel or mode, as a sensor sees it, reads and writes its own.
    """
    counts = {
        (kind, place): int(((events.kinds == kind) & (events.loops == place)).sum())
        for kind in (READ, ACT)
        for place in range(len(loops))
    }
    looks = int((events.kinds == LOOK).sum())
    products = numbers = 0.0
    for place, loop in enumerate(loops):
        reads, acts, p = counts[READ, place], counts[ACT, place], len(loop.actuator.stroke)
        assert isinstance(loop.actuator.dynamics, Dynamics)
        n = len(loop.actuator.dynamics)
        matrices = reads * loop.sees.size + acts * p * loop.readings + acts * len(loops) * structure * p
        products += matrices * cases
        numbers += matrices
        for eye in range(len(loops)):
            steps = counts[READ, eye] + acts + looks * (eye == 0)
            for count, states in ((p, n), (structure, n + 2)):
                products += steps * cases * count * (states**2 + 2 * states + 1)
                numbers += steps * cases * count * 2 * (states + 1)
    return products, 8 * numbers


def _beside(hertz: list[float], shares: list[float]) -> Dynamics:
    """Return modes beside each other that share what they are given."""
    modes = [second_order(one, 0.01) for one in hertz]
    c = np.concatenate([share * mode.c for share, mode in zip(shares, modes, strict=True)])
    return Dynamics(block_diag(*(mode.a for mode in modes)), np.concatenate([mode.b for mode in modes]), c)


def median(job: object, repeats: int = REPEATS) -> float:
    """Return the median of the processor's seconds that a job takes."""
    assert callable(job)
    warm(job)
    spent = []
    for _ in range(repeats):
        begin = time.process_time()
        job()
        spent.append(time.process_time() - begin)
    return float(np.median(spent))


def bounds() -> tuple[float, float]:
    """Return multiply-adds and bytes per second of this machine."""
    a, b = np.ones((_SIZE, _SIZE)), np.ones((_SIZE, _SIZE))
    source, target = np.ones(_COPIED), np.ones(_COPIED)
    products = _SIZE**3 / median(lambda: a @ b)
    return products, 16.0 * _COPIED / median(lambda: np.copyto(target, source))


def main() -> None:
    """Print the table."""
    console = Console(width=120)
    with threadpool_limits(1):
        products, copied = bounds()
        table = Table(title=f"{products / 1e9:.1f} G multiply-adds and {copied / 1e9:.1f} GB per second")
        for head in ("channels", "cases", "times real time", "of multiply-adds", "of memory", "us per event"):
            table.add_column(head, justify="right")
        for channels in CHANNELS:
            loop, events = loop_of(channels)
            for cases in CASES:
                seen = np.random.default_rng(1).standard_normal((FRAMES, channels, cases))

                def job(loop: Loop = loop, events: Schedule = events, seen: Array = seen) -> object:
                    return run([loop], events, [seen], 1)

                spent = median(job)
                # Two matrices by the cases of a batch, and per event 14 numbers of each channel.
                work = FRAMES * cases * (2 * channels**2 + 2 * 14 * channels)
                moved = FRAMES * 8 * (2 * channels**2 + 2 * 14 * channels * cases)
                table.add_row(
                    str(channels),
                    str(cases),
                    f"{FRAMES * FRAME * cases / spent:.3g}",
                    f"{100 * work / products / spent:.0f} %",
                    f"{100 * moved / copied / spent:.0f} %",
                    f"{1e6 * spent / len(events.kinds):.0f}",
                )
        console.print(table)
        whole = Table(title=f"{SEGMENTS} actuators, {EDGES} edge sensors, 50 Hz and 1 kHz")
        for head in (
            "modes of segments",
            "of the structure",
            "cases",
            "times real time",
            "of multiply-adds",
            "of memory",
            "us per event and case",
        ):
            whole.add_column(head, justify="right")
        for (shares, structure), cases in product(product(SHARES, STRUCTURES), TOGETHER):
            if cases == TOGETHER[0]:
                loops, events, answers = telescope(shares, structure)
            modes = (1 + len(shares)) * SEGMENTS
            frames = [frame_count(one.timing, SECONDS) for one in loops]
            read = [
                np.random.default_rng(1).standard_normal((count, len(one.sees), cases))
                for count, one in zip(frames, loops, strict=True)
            ]
            spent = median(partial(run, loops, events, read, 1, answers), 3)
            work, moved = least(loops, events, structure, cases)
            whole.add_row(
                f"{modes}",
                f"{structure}",
                f"{cases}",
                f"{(speed := SECONDS * cases / spent):.3g}",
                f"{100 * work / products / spent:.0f} %",
                f"{100 * moved / copied / spent:.0f} %",
                f"{1e6 * spent / len(events.kinds) / cases:.0f}",
            )
        console.print(whole)
        name = f"a telescope of {modes} + {structure} modes, {cases} cases: times real time of a core"
        console.print(verdict([(name, speed, 5.0, 10.0)]))
        console.print(PEERS, highlight=False)


if __name__ == "__main__":
    main()
