"""What a loop leaves of white forces and sensor noise: stationary covariances (Lyapunov), and spectra."""

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from wavequake.control.linear import Array
from wavequake.control.robustness.feedback import Loop, closed_matrix
from wavequake.control.robustness.margins import controller_transfer
from wavequake.control.robustness.plant import Complex, Plant, linear, transfer

_BLOCK = 256


def open_covariance(plant: Plant) -> Array:
    """Return the covariance of the modal coordinates (n, n) under unit white forces, without a controller.

    Modes a, b with force correlation F: the (q, q') covariance solves three linear equations, of which
    P_qq = F (d_a + d_b) / ((d_a + d_b)(d_a w_b^2 + d_b w_a^2) + (w_a^2 - w_b^2)^2).
    """
    forces = plant.inputs @ plant.inputs.T
    rate = plant.rates[:, None] + plant.rates
    mixed = plant.rates[:, None] * plant.squared + plant.rates * plant.squared[:, None]
    return np.asarray(forces * rate / (rate * mixed + (plant.squared[:, None] - plant.squared) ** 2))


def closed_covariance(loop: Loop, noise: float) -> tuple[Array, Array]:
    """Return the covariances of modal coordinates (n, n) and of the controller's forces (p, p).

    White forces of unit intensity act at the inputs, white noise of the intensity `noise` at the outputs. The
    loop is stable.
    """
    plant, own = linear(loop.plant), loop.controller
    forced = np.vstack([plant.b, own.b @ plant.d])
    noisy = np.vstack([np.zeros((len(plant.a), own.b.shape[1])), own.b])
    covariance = solve_continuous_lyapunov(
        closed_matrix(loop), -(forced @ forced.T + noise * noisy @ noisy.T)
    )
    count = len(loop.plant.squared)
    mine = covariance[len(plant.a) :, len(plant.a) :]
    return np.asarray(covariance[:count, :count]), np.asarray(own.c @ mine @ own.c.T)


def shown_forces(plant: Plant, gram: Array, omega: Array) -> Complex:
    """Return what forces at frequencies (f,) do to a quadratic form q' gram q of the modes, (f, p, p).

    Forces u of one frequency give it the mean u^H N u / 2.
    """
    found = []
    for first in range(0, len(omega), _BLOCK):
        s = 1j * omega[first : first + _BLOCK, None]
        moved = plant.inputs / (plant.squared + s * (plant.rates + s))[:, :, None]
        found.append(np.swapaxes(moved.conj(), 1, 2) @ (gram @ moved))
    return np.asarray(np.concatenate(found))


def open_spectrum(forces: Complex) -> Array:
    """Return the one-sided spectrum (f,) of a form under unit white forces, without a controller."""
    return np.asarray(2.0 * np.trace(forces, axis1=1, axis2=2).real)


def closed_spectra(loop: Loop, forces: Complex, noise: float, omega: Array) -> tuple[Array, Array]:
    """Return what a stable loop makes of it, by the forces and by the sensors' noise, (f,) each.

    Per unit of ordinary frequency, omega / (2 pi). Forces and noise are those of `closed_covariance`, whose
    quadratic form is the integral of both; `forces` are those of `shown_forces`.
    """
    s = np.asarray(1j * omega, dtype=np.complex128)
    own, plant = controller_transfer(loop, s), transfer(loop.plant, s)
    left = np.linalg.inv(np.eye(own.shape[1]) + own @ plant)
    through = (left, np.sqrt(noise) * left @ own)
    by_forces, by_noise = (
        2.0 * np.einsum("fim,fij,fjm->f", one.conj(), forces, one, optimize=True).real for one in through
    )
    return by_forces, by_noise
