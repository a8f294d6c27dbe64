"""How fast the time response of a reduced mirror is, and how exact.

99 oscillators of the circular mirror (craigb108, nine prescribed interface directions), 2000 steps of 0.1 ms:
a 100 Hz sinusoid from rest, a ramped one and random motion, one case and batches of 16, against the average
acceleration of Newmark, SciPy's DOP853 and python-control's forced_response on the same system. One thread;
measurements are interleaved, and medians of same-run ratios are what to compare between machines. Errors are
relative to the largest displacement at the optical surface; the reference propagates the dense matrix
exponential of the state and input.
"""

import itertools
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_limits

from wavequake.mechanics.mirrors.models import CircularMirror, circular_mirror
from wavequake.mechanics.vibration.drive import Drive, sampled, values
from wavequake.mechanics.vibration.excitations import RandomVibration, Sinusoid, drive_of
from wavequake.mechanics.vibration.modal import ModalModel, modal_model
from wavequake.mechanics.vibration.response import displacements, respond
from wavequake.mechanics.vibration.state_space import StateSpace, state_space
from wavequake.reduction.reduce import reduce

Array = NDArray[np.float64]
Run = Callable[[], Array]

STEP, STEPS, BATCH, REPEATS = 1e-4, 2000, 16, 7
TIME = STEP * np.arange(STEPS)
NODES = 8


def exponential(system: StateSpace, samples: Array) -> Array:
    """Exact outputs for samples joined by lines: the dense exponential, step by step."""
    states, inputs = system.b.shape
    whole = np.zeros((states + 2 * inputs,) * 2)
    whole[:states, :states] = system.a * STEP
    whole[:states, states : states + inputs] = system.b * STEP
    whole[states : states + inputs, states + inputs :] = np.eye(inputs)
    power = scipy.linalg.expm(whole)[:states]
    state, outputs = np.zeros(states), [system.d @ samples[0]]
    for before, after in itertools.pairwise(samples):
        state = power @ np.concatenate([state, before, after - before])
        outputs.append(system.c @ state + system.d @ after)
    return np.array(outputs)


def harmonic(system: StateSpace, omega: float, pattern: Array, phase: float = 0.0) -> Array:
    """Exact outputs under pattern * sin(omega t + phase): dense exponential with the driving oscillator."""
    states = len(system.a)
    whole = np.zeros((states + 2,) * 2)
    whole[:states, :states] = system.a
    whole[:states, states] = system.b @ pattern
    whole[states:, states:] = omega * np.array([[0, 1], [-1, 0]])
    power = scipy.linalg.expm(whole * STEP)
    state, outputs = np.concatenate([np.zeros(states), [np.sin(phase), np.cos(phase)]]), []
    for _ in TIME:
        outputs.append(system.c @ state[:states] + system.d @ pattern * state[states])
        state = power @ state
    return np.array(outputs)


def newmark(system: StateSpace, samples: Array) -> Array:
    """Average acceleration: for linear systems the trapezoidal rule, with one factorization."""
    states = len(system.a)
    factor = scipy.linalg.lu_factor(np.eye(states) - 0.5 * STEP * system.a)
    step = scipy.linalg.lu_solve(factor, np.eye(states) + 0.5 * STEP * system.a)
    push = scipy.linalg.lu_solve(factor, 0.5 * STEP * system.b) @ (samples[:-1] + samples[1:]).T
    state, history = np.zeros(states), [np.zeros(states)]
    for force in push.T:
        state = step @ state + force
        history.append(state)
    return np.array(history) @ system.c.T + samples @ system.d.T


def runge_kutta(system: StateSpace, omega: float, pattern: Array) -> Array:
    """DOP853 at its tolerance of 1e-6 under a sinusoid."""
    push = system.b @ pattern

    def derivative(t: float, state: Array) -> Array:
        return system.a @ state + push * np.sin(omega * t)

    found = solve_ivp(
        derivative,
        (0, TIME[-1]),
        np.zeros(len(system.a)),
        t_eval=TIME,
        method="DOP853",
        rtol=1e-6,
        atol=1e-12,
    )
    result: Array = found.y.T @ system.c.T + np.outer(np.sin(omega * TIME), system.d @ pattern)
    return result


def forced_response(system: StateSpace, samples: Array) -> Array:
    """Run the same in python-control, from the state space on."""
    import control

    result: Array = control.forced_response(control.ss(*system), TIME, samples.T).outputs.T
    return result


def contestants(modal: ModalModel, rows: Array, system: StateSpace) -> dict[str, tuple[Run, int, Array]]:
    """Each run, its number of cases, and what its first case should be."""
    sine = drive_of(Sinusoid(name="sine"), 3, TIME)
    ramped = drive_of(Sinusoid(name="ramped", ramp_s=0.0105), 3, TIME)
    noise = drive_of(RandomVibration(name="noise", rms=1e-6), 3, TIME)
    omega, pattern = sine.harmonics[0].omega, sine.harmonics[0].sine
    held = values(sine, TIME)

    def ours(*drives: Drive) -> Array:
        return displacements(respond(modal, drives, TIME), rows)[0]

    exact_sine, exact_held = harmonic(system, omega, pattern), exponential(system, held)
    exact_noise = exponential(system, values(noise, TIME))
    exact_ramped = np.zeros_like(exact_sine)
    for wave in ramped.harmonics:
        late = round(wave.start / STEP)
        exact_ramped[late:] += harmonic(system, wave.omega, wave.sine, wave.omega * wave.start)[
            : STEPS - late
        ]
    runs: dict[str, tuple[Run, int, Array]] = {}
    for name, drive, exact in (
        ("sinusoid", sine, exact_sine),
        ("ramped sinusoid", ramped, exact_ramped),
        ("random samples", noise, exact_noise),
    ):
        runs[f"{name}, 1 case"] = (partial(ours, drive), 1, exact)
        runs[f"{name}, {BATCH} cases"] = (partial(ours, *[drive] * BATCH), BATCH, exact)
    runs["sinusoid, sampled"] = (partial(ours, sampled(sine, TIME)), 1, exact_sine)
    runs["Newmark, sinusoid"] = (partial(newmark, system, held), 1, exact_sine)
    runs["DOP853, sinusoid"] = (partial(runge_kutta, system, omega, pattern), 1, exact_sine)
    try:
        forced_response(system, held)
    except ImportError:
        return runs
    return runs | {
        "python-control, sampled sinusoid": (partial(forced_response, system, held), 1, exact_held)
    }


def table(seconds: dict[str, list[float]], runs: dict[str, tuple[Run, int, Array]]) -> Table:
    """Medians per case, ratios within one round to one case of the exact sinusoid, and errors."""
    columns = Table(*("response", "ms/case", "time/exact", "relative error"), box=None)
    exact = np.array(seconds["sinusoid, 1 case"])
    for name, (run, cases, expected) in runs.items():
        each = np.array(seconds[name]) / cases
        error = np.abs(run() - expected).max() / np.abs(expected).max()
        columns.add_row(
            name, f"{1e3 * np.median(each):.2f}", f"{np.median(each / exact):.2f}", f"{error:.1e}"
        )
    return columns


def main() -> None:
    with threadpool_limits(1):
        body = reduce(circular_mirror(CircularMirror()), "craigb108")
        rows = body.surface[: 3 * NODES]
        begin = time.perf_counter()
        modal = modal_model(body, np.ones(body.inputs.shape[1], dtype=bool))
        preparation = time.perf_counter() - begin
        runs = contestants(modal, rows, state_space(modal, rows))
        seconds: dict[str, list[float]] = {name: [] for name in runs}
        for _ in range(REPEATS):
            for name, (run, _, _) in runs.items():
                start = time.perf_counter()
                run()
                seconds[name].append(time.perf_counter() - start)
        console = Console()
        console.print(
            f"{len(modal.squared)} oscillators, {STEPS} steps; modal form {1e3 * preparation:.1f} ms"
        )
        console.print(table(seconds, runs))


if __name__ == "__main__":
    main()
