"""Fit the synthetic lens bench and write it: ``python docs/make_lens_bench.py`` (minutes).

Goes on from the bench that is there; ``python docs/make_lens_bench.py 1`` begins at a random place. The
bench of the package was found from start 1, in stages like these and with bounds drawn closer on the way, and
kept once it met what is told (tests/control/test_lens_bench.py). It is no minimum: squares would shrink
further, but what is told is rounded, and many benches meet it.

Masses and springs of the real bench are not published. They are solved for by least squares from what is:
facts about the bench, and what the reference's controllers leave without errors in another simulation of it.
"""

import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.optimize import least_squares

from wavequake.control.bench import (
    SENSITIVITIES,
    Bench,
    bench_modes,
    fitted_bench,
    force_column,
    image_row,
    measured_row,
)
from wavequake.control.hammer import HAMMER, step_means
from wavequake.control.linear import zero_order_hold
from wavequake.control.loop import late_deviation, peak_to_peak, remaining_image
from wavequake.control.regulator import blow_spectrum
from wavequake.control.stage import Stage, stage_model
from wavequake.control.thesis import SampledController, estimator_only, feed_forward, future_integration

Array = NDArray[np.float64]

PAGE = Path(__file__).parents[1] / "pipeline" / "wavequake" / "control" / "lens_bench.toml"
HEAD = """\
# A SYNTHETIC bench, made by docs/make_lens_bench.py: the parameters of the real one are not published. These
# meet what is (Störkle 2018, Chapter 5: frequencies of 20 to 80 rad/s, image, stage), what is told
# of the bench of another simulation, and what the reference's controllers left on that one without any error.
# What they leave with errors was not fitted. Masses in kg, springs in N/m. Lens 5, its ring and their springs
# swing in the passive bench only.
"""
TAIL = """\
# Configuration (b) of Störkle 2018, Fig. 5.37: what is left of the springs between lens and ring, in shares,
# where the lower of two is taken out.
lower_spring_removed = [0.8, 0.8, 0.8, 0.8, 0.8, 0.8]
"""

# Undamped frequencies with 11 degrees of freedom, the first and last with 13, rad/s.
OMEGA = np.array([20, 24, 28, 32.9, 37.9, 44, 51, 58, 65.1, 72, 80])
PASSIVE = np.array([15.6, 80.3])
# After the blow: least and largest image, lens 4 and housing at most, mm; stage and lens 4 at most, mm/s.
EXTREMES = np.array([-3.0, 3.99, 2.94, 1.5, 123.0, 148.0])
# Least amplitude of a mode in lens 4 after the blow, as a share of the largest.
SEEN = 0.03
# Range and standard deviation that FF, FI, FF+FI and the filter alone leave, in % of uncontrolled.
LEFT = np.array([[31.8, 25.5], [67, 25], [11.5, 10.1], [48, 39]])

# Plain values, around which random starts lie, and towards which what nothing else fixes is drawn.
PLAIN = {"lens_kg": (0.11, 6), "ring_kg": (0.2, 6), "housing_kg": (0.85, 0), "lens_springs": (170.0, 6),
         "ring_springs": (320.0, 6), "couplings": (70.0, 5), "housing_spring": (1400.0, 0)}  # fmt: skip
SPREAD, BOUND = 0.3, 0.83


class Search(NamedTuple):
    """What may be off in a stage of the search: frequencies and housing as shares, what is left in points."""

    rates: float
    housing: float
    controllers: float  # 0: not asked
    steps: int


# Loosely at first, so that steps are long.
FIRST = (Search(0.01, 0.02, 0, 30), Search(0.01, 0.02, 0.25, 25), Search(0.005, 0.012, 0.3, 25))
LAST = Search(0.0042, 0.012, 0.25, 60)

DURATION, STEP, BLOW = 7.0, 1e-3, 16
TIME = STEP * np.arange(round(DURATION / STEP) + 1)
STAGE = Stage()


def bench_of(factors: Array, active: bool = True) -> Bench:
    """Return the bench whose parameters are plain values times e^factors."""
    values, place = {}, 0
    for name, (plain, count) in PLAIN.items():
        grown = plain * np.exp(factors[place : place + max(count, 1)])
        values[name] = grown if count else float(grown[0])
        place += max(count, 1)
    return Bench(**values, active=active)  # type: ignore[arg-type]


def swing(bench: Bench) -> Array:
    """Return image, lens 4 and housing after the blow, (k, 3) in m: without friction, in closed form."""
    modes = bench_modes(bench)
    grown = np.exp(modes.poles * STEP)
    push = (grown - 1) / modes.poles * (force_column(bench) @ modes.shapes)
    state = np.zeros((len(TIME), len(grown)), dtype=complex)
    for k, force in enumerate(step_means(HAMMER, STEP, BLOW)):
        state[k + 1] = grown * state[k] + push * force
    state[BLOW:] = state[BLOW] * np.exp(np.outer(TIME[: len(TIME) - BLOW], modes.poles))
    rows = np.stack([image_row(bench), measured_row(bench), force_column(bench)])
    return np.asarray(state.imag / modes.poles.imag @ (rows @ modes.shapes).T)


def extremes(histories: Array) -> Array:
    """Return what `EXTREMES` lists."""
    image, lens, housing = 1e3 * histories.T
    target = -image / SENSITIVITIES[4]
    speeds = [np.abs(np.gradient(one, STEP)).max() for one in (target, lens)]
    return np.array([image.min(), image.max(), np.abs(lens).max(), np.abs(housing).max(), *speeds])


def smallest_share(bench: Bench) -> float:
    """Return the least amplitude of a mode in lens 4 after the blow, as a share of the largest."""
    modes = bench_modes(bench)
    shapes = (measured_row(bench) @ modes.shapes) * (force_column(bench) @ modes.shapes)
    sizes = np.abs(shapes / modes.poles.imag * blow_spectrum(HAMMER, modes.poles))
    return float(sizes.min() / sizes.max())


def controllers(bench: Bench) -> list[SampledController]:
    """Return the controllers of `LEFT`."""
    both = feed_forward(bench, STAGE, ahead=2)
    return [feed_forward(bench, STAGE), future_integration(bench), both, estimator_only(bench)]


def left(one: SampledController, image: Array, lens: Array) -> Array:
    """Return range and deviation that a controller leaves, %; without converters, for smooth derivatives."""
    every, late = round(one.sample_time / STEP), round(one.compute_delay / STEP)
    seen = lens[::every]
    force = step_means(HAMMER, one.sample_time, len(seen))
    factors, vectors = np.linalg.eig(one.a)
    driven = np.linalg.solve(vectors, one.b.astype(complex)) * (one.c @ vectors)[:, None]
    command = one.d @ np.stack([seen, force])
    for factor, row in zip(factors, driven @ np.stack([seen, force]), strict=True):
        command = command + scipy.signal.lfilter([0, 1], [1, -factor], row).real
    held = np.concatenate([np.zeros(late), np.repeat(command, every)])[: len(image)]
    model = zero_order_hold(stage_model(STAGE), STEP)
    up, down = scipy.signal.ss2tf(model.a, model.b, model.c, model.d)
    rest = remaining_image(image, scipy.signal.lfilter(up[0], down, held))
    ratios = (
        peak_to_peak(rest) / peak_to_peak(image),
        late_deviation(rest, TIME) / late_deviation(image, TIME),
    )
    return 100 * np.array(ratios)


def rates(factors: Array) -> Array:
    """Return by which shares frequencies are off: 11 of the active bench, 2 of the passive one."""
    found = bench_modes(bench_of(factors)).omega
    passive = bench_modes(bench_of(factors, active=False)).omega[[0, -1]]
    return np.concatenate([found / OMEGA, passive / PASSIVE]) - 1


def residual(factors: Array, stage: Search) -> Array:
    """Return how far everything is off, as multiples of what it may be off, and the factors' own sizes."""
    bench = bench_of(factors)
    histories = swing(bench)
    parts = [
        rates(factors) / (stage.rates * np.repeat([1, 0.3], [11, 2])),
        (extremes(histories) / EXTREMES - 1) / [0.004, 0.004, 0.004, stage.housing, 0.004, 0.004],
        [min(0.0, smallest_share(bench) / (SEEN + 0.004) - 1) / 0.05],
        factors / 1.2,
    ]
    if stage.controllers:
        found = [left(one, *histories.T[:2]) for one in controllers(bench)]
        parts.append((np.ravel(found) - LEFT.ravel()) / stage.controllers)
    return np.concatenate(parts)


def random_start(seed: int) -> Array:
    """Return factors with about the right frequencies."""
    count = sum(max(many, 1) for _, many in PLAIN.values())
    near = least_squares(
        lambda x: np.concatenate([rates(x) / 0.02, x / 0.6]),
        SPREAD * np.random.default_rng(seed).standard_normal(count),
        method="lm",
        max_nfev=2000,
    )
    return np.asarray(np.clip(near.x, -0.9 * BOUND, 0.9 * BOUND))


def factors_of(bench: Bench) -> Array:
    """Return the logarithms of a bench's parameters over the plain values."""
    parts = [np.log(np.atleast_1d(getattr(bench, name)) / plain) for name, (plain, _) in PLAIN.items()]
    return np.concatenate(parts)


def fit(factors: Array, stages: Iterable[Search]) -> Array:
    """Search for what is told, stage after stage; print half the sum of squares of each."""
    for stage in stages:
        found = least_squares(
            residual, factors, args=(stage,), diff_step=1e-4, max_nfev=stage.steps, bounds=(-BOUND, BOUND)
        )
        factors = found.x
        print(f"{stage}: {found.cost:.1f} after {found.nfev} steps", flush=True)
    return factors


def text_of(bench: Bench) -> str:
    """Return the bench as TOML, four digits each."""
    lines = []
    for name, (_, count) in PLAIN.items():
        values = [f"{one:.4g}" for one in np.atleast_1d(getattr(bench, name))]
        lines.append(f"{name} = [{', '.join(values)}]" if count else f"{name} = {values[0]}")
    return HEAD + "\n".join(lines) + "\n" + TAIL


if __name__ == "__main__":
    anew = len(sys.argv) > 1
    start = random_start(int(sys.argv[1])) if anew else factors_of(fitted_bench())
    best = fit(start, (*FIRST, LAST) if anew else (LAST,))
    PAGE.write_text(text_of(bench_of(best)), encoding="utf-8")
