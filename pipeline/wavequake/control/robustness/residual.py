"""What a loop leaves of white forces and sensor noise: the exact stationary covariance (Lyapunov)."""

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from wavequake.control.linear import Array
from wavequake.control.robustness.feedback import Loop, closed_matrix
from wavequake.control.robustness.plant import Plant, linear


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
