"""Fourier transforms of pupils, with their NumPy twins."""
