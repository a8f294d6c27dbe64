"""Small mirror studies, and independent truths about a parabola that images a star on its axis."""

import numpy as np

MOR = {
    "model.shapes": ["circular"],
    "model.rings": 2,
    "reduction.variants": ["craigb18", "rubin18", "krylov36(150)"],
    "reduction.frequencies": 24,
    "imaging.pixels": 8,
    "imaging.pupil_samples": 16,
    "imaging.instants": 3,
    "optics.rays": 200,
    "optics.zernike_terms": 11,
    "time.duration_s": 0.005,
    "excitation.sine300.interfaces": [1],
}
TRACE = {
    "model.shapes": ["circular"],
    "model.rings": 2,
    "reduction.variants": ["craigb18"],
    "optics.rays": 120,
    "optics.zernike_terms": 11,
    "time.duration_s": 0.005,
}


def eleven(x, y):
    """Noll's first eleven circular polynomials, written out (Noll 1976, Table I), shape (points, 11)."""
    r2 = x * x + y * y
    columns = [
        np.ones_like(x),
        2 * x,
        2 * y,
        np.sqrt(3) * (2 * r2 - 1),
        2 * np.sqrt(6) * x * y,
        np.sqrt(6) * (x * x - y * y),
        np.sqrt(8) * (3 * r2 - 2) * y,
        np.sqrt(8) * (3 * r2 - 2) * x,
        np.sqrt(8) * (3 * x * x * y - y**3),
        np.sqrt(8) * (x**3 - 3 * x * y * y),
        np.sqrt(5) * (6 * r2 * r2 - 6 * r2 + 1),
    ]
    return np.stack(columns, axis=1)


def slope_at_the_vertex(radius):
    """Derivatives in x and y of the eleven polynomials at the center of a pupil, shape (2, 11)."""
    at_x = [0, 2, 0, 0, 0, 0, 0, -2 * np.sqrt(8), 0, 0, 0]
    at_y = [0, 0, 2, 0, 0, 0, -2 * np.sqrt(8), 0, 0, 0, 0]
    return np.array([at_x, at_y]) / radius


def wavefront_of(figures, x, y, radius, focal_length):
    """OPD (figures, rays) that small figures along the light (coefficients, mm) make, to first order, mm.

    A surface that moves by h along the light k_in lengthens the path by (k_in - k_out) . h. The chief ray
    lands at d = 2 f times the slope at the vertex, and the reference sphere about that point adds k_out . d.
    """
    sag = (x * x + y * y) / (4 * focal_length)
    height = figures @ eleven(x / radius, y / radius).T
    center = figures @ eleven(np.zeros(1), np.zeros(1)).T
    landing = 2 * focal_length * (figures @ slope_at_the_vertex(radius).T)
    cosines = -np.stack([x, y]) / (focal_length + sag)
    path = height * 2 * focal_length / (focal_length + sag) + landing @ cosines
    return 2 * center - path
