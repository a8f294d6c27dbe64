"""Loads over time on an assembly against an integration of the dense equations of motion."""

import numpy as np
from scipy.integrate import solve_ivp
from test_assembly import GROUND, bar, chain, spring

from wavequake.mechanics.assembly.forced import forced
from wavequake.mechanics.assembly.links import End
from wavequake.mechanics.assembly.plant import plant

RNG = np.random.default_rng(7)


def test_forces_and_floor_motions_over_time_are_those_of_an_integration_of_the_dense_equations():
    """A chain on a spring and a damper that is not proportional; uneven rows, instants anywhere."""
    links = [spring("foot", End("whole", "0"), GROUND, (1e5, 2e5, 3e5), (40.0, 50.0, 60.0))]
    found = plant([chain("whole", 3)], links)
    mass, stiffness, _ = bar(3)
    select = np.zeros((len(mass), 3))
    select[:3] = np.eye(3)
    springs, dampers = np.diag([1e5, 2e5, 3e5]), np.diag([40.0, 50.0, 60.0])
    stiff = stiffness + select @ springs @ select.T
    damp = 1e-4 * stiffness + select @ dampers @ select.T
    rows = np.array([0.001, 0.004, 0.0052, 0.009, 0.015, 0.02])
    floor = np.vstack([np.zeros(3), RNG.normal(size=(5, 3))]) * 1e-5
    force = RNG.normal(size=(6, 3))  # it begins with a step
    loads = np.zeros((6, found.modal.inputs.shape[1]))
    loads[:, :3] = floor
    loads[:, found.places["whole.2"][0]] = force

    state, expected, time = np.zeros(2 * len(mass)), [], []
    for row in range(5):
        step = rows[row + 1] - rows[row]
        rate = (floor[row + 1] - floor[row]) / step

        def motion(t, y, row=row, step=step, rate=rate):
            share = (t - rows[row]) / step
            at = floor[row] + share * (floor[row + 1] - floor[row])
            push = select @ (springs @ at + dampers @ rate)
            push[6:9] += force[row] + share * (force[row + 1] - force[row])
            x, v = np.split(y, 2)
            return np.concatenate([v, np.linalg.solve(mass, push - stiff @ x - damp @ v)])

        inside = np.linspace(rows[row], rows[row + 1], 4)
        run = solve_ivp(motion, inside[[0, -1]], state, "DOP853", inside, rtol=1e-11, atol=1e-18)
        state = run.y[:, -1]
        time += inside[1:].tolist()
        expected += run.y[: len(mass), 1:].T.tolist()
    order = RNG.permutation(len(time))
    answer = forced(found, rows, loads, np.array(time)[order])
    wanted = np.array(expected)[order][:, -3:]  # the output is its end's motion
    np.testing.assert_allclose(answer[:, :3], wanted, rtol=0, atol=1e-8 * np.abs(wanted).max())


def test_nothing_moves_before_the_first_row_and_loads_stay_after_the_last_one():
    links = [spring("foot", End("whole", "0"), GROUND, (1e5, 1e5, 1e5), (900.0, 900.0, 900.0))]
    found = plant([chain("whole", 3)], links)
    loads = np.zeros((2, found.modal.inputs.shape[1]))
    loads[:, found.places["whole.2"][0].start] = 3.0
    early, late = forced(found, np.array([0.1, 0.2]), loads, np.array([0.05, 20.0]))
    assert not early.any()
    foot = 3.0 / 1e5
    stretch = np.linalg.lstsq(bar(3)[1], np.eye(9)[6] - np.eye(9)[0], rcond=None)[0]
    np.testing.assert_allclose(late[0], foot + 3.0 * (stretch[6] - stretch[0]), rtol=1e-9)
