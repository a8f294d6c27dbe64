"""Refractive media: glasses by catalogue and formula, and indices that vary in space."""
