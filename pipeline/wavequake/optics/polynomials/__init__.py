"""Zernike polynomials: values, indices, transforms between pupils."""
