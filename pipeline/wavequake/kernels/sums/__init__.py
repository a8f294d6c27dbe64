"""Sums over rays: path differences, fits, moments, Strehl ratios."""
