"""Disturbances and structural dynamics (SI units)."""
