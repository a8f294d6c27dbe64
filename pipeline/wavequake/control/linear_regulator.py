"""Any sampled linear controller of one reading and one command, as the modal regulator that boards run.

The regulator's modes decay (steps s), and what they leave of the reading, e = y - Re Σ z, corrects them. With
gains g it has the poles μ of a controller K if 1 + Σ s_j g_j / (z - s_j) = Π (z - μ_i) / Π (z - s_i), and K's
command if K(0) = 0 and the row is K(s_j): an output regulator again, whose modes are chosen. So an integrator
runs on modes that decay. A controller that is not 0 at z = 0 gets the poles 0 and 0.4 on top, which cancel.
"""

from itertools import count

import numpy as np

from wavequake.control.linear import Array, LinearModel, linear_model
from wavequake.control.regulator import Complex, ModalRegulator
from wavequake.errors import UserError
from wavequake.user_files import read_npz

# On top: a pole between two steps shares the gain, which is 1 in total, out to both.
_TOP_POLES, _TOP_STEPS = (0.0, 0.4), (0.6, 0.2)
# From a pole to its step: nearer, rows grow; farther, gains do.
_NEAR = 0.04
_ROUNDING = 1e-9
# Rounding parts double poles by its square root: those on the unit circle come out just beyond it.
_GROWING = 1e-6


def read_controller(data: bytes) -> LinearModel:
    """Return the sampled controller of an .npz file: arrays ``A``, ``B``, ``C``, ``D`` and ``sample_time_s``.

    Raises
    ------
    UserError
        If the file is damaged, lacks one of them, or they do not fit each other; without the file's name.
    """
    arrays, wanted = read_npz(data), ("A", "B", "C", "D", "sample_time_s")
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise UserError(
            f"it has no {', '.join(missing)}; a sampled controller is np.savez(file, A=..., B=..., C=..., "
            "D=..., sample_time_s=...)"
        )
    for name in wanted:
        if arrays[name].dtype.kind not in "fiu":
            raise UserError(f"{name} holds {arrays[name].dtype}, not real numbers")
    time = arrays["sample_time_s"]
    if time.size != 1 or not 0 < float(time.item()) < np.inf:
        raise UserError("sample_time_s must be one positive number")
    a, b, c, d = (arrays[name] for name in wanted[:4])
    if a.ndim != 2 or not len(a) or b.ndim != 2 or len(b) != len(a):
        raise UserError(f"A has shape {a.shape} and B {b.shape}; (n, n) and (n, 1) are needed, n > 0")
    return linear_model(a, b, c, d, float(time.item()))


def linear_regulator(controller: LinearModel, compute_delay: float = 0.0002) -> ModalRegulator:
    """Return the modal regulator that does what a controller does.

    Parameters
    ----------
    controller : LinearModel
        Sampled; one input (the reading, m) and one output (the command, m).
    compute_delay : float
        Of the board, s.

    Raises
    ------
    UserError
        If the controller is continuous, has several inputs or outputs, grows by itself, or has no finite
        regulator.
    """
    a, b, c, d = controller.a, controller.b, controller.c, controller.d
    if not controller.sample_time:
        raise UserError("The controller is continuous; boards run sampled ones: give its sample time.")
    if d.shape != (1, 1):
        raise UserError(
            f"The controller has {d.shape[1]} inputs and {d.shape[0]} outputs; the boards read one position "
            "and give one command."
        )
    poles = np.linalg.eigvals(a).astype(complex)
    if np.abs(poles).max() > 1 + _GROWING:
        raise UserError(
            f"The controller grows by itself: it has a pole of magnitude {np.abs(poles).max():.7g}. Switched "
            "on while its loop is open, it would run into its limits."
        )
    steps = _steps(poles)
    if not _is_zero_at_zero(controller, poles):
        taken = np.append(poles, steps)
        shifts = (0.01 * turn + np.array(_TOP_STEPS) for turn in count())
        top = next(one for one in shifts if np.abs(one[:, None] - taken).min() > _NEAR / 8)
        poles, steps = np.append(poles, _TOP_POLES), np.append(steps, top)
    others = steps[:, None] - steps + np.eye(len(steps))
    gains = np.prod(steps[:, None] - poles, axis=1) / np.prod(others, axis=1) / steps
    with np.errstate(over="ignore", invalid="ignore"):
        rows = np.array([_response(a, b, c, d, step) for step in steps])
    if not (np.isfinite(rows).all() and np.isfinite(gains).all()):
        raise UserError(
            "The controller overflows: the products of its B and C are too large to compute with."
        )
    kept = steps.imag >= 0
    pairs = np.where(steps.imag > 0, 2.0, 1.0)  # a mode's real part is half the sum of a pair
    return ModalRegulator(
        name="linear",
        sample_time=controller.sample_time,
        compute_delay=compute_delay,
        step=steps[kept],
        gain=(gains * pairs)[kept],
        row=rows[kept],
        start=np.zeros((1, int(kept.sum())), dtype=complex),
    )


def _response(a: Array, b: Array, c: Array, d: Array, z: complex) -> complex:
    return complex((d + c @ np.linalg.solve(z * np.eye(len(a)) - a, b))[0, 0])


def _is_zero_at_zero(controller: LinearModel, poles: Complex) -> bool:
    """Return whether a controller is 0 at z = 0, as one is that acts on what its reading has corrected."""
    if not len(poles) or np.abs(poles).min() < _ROUNDING:
        return False
    matrices = controller.a, controller.b, controller.c, controller.d
    with np.errstate(over="ignore", invalid="ignore"):
        return abs(_response(*matrices, 0.0)) <= _ROUNDING * abs(_response(*matrices, 2.0))


def _steps(poles: Complex) -> Complex:
    """Return decaying steps near poles, real or in pairs as they are, so that gains and rows are moderate."""
    chosen: list[complex] = []
    for pole in poles[poles.imag >= 0]:
        away = -pole if abs(pole) >= 0.5 else 1.0  # inwards; those of delays, at 0, outwards
        apart = np.abs(poles - pole)
        near = min(_NEAR, 0.5 * np.min(apart[apart > _NEAR / 8], initial=1.0))
        for trial in count(1):
            step = complex(pole + near * trial**2 * away)
            taken = [*chosen, *np.conj(chosen), *poles]
            if abs(step) < 1 and min(abs(step - other) for other in taken) > near / 3:
                break
        chosen += [step, step.conjugate()] if pole.imag else [step]
    return np.array(chosen)
