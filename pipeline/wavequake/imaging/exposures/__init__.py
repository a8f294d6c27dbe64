"""Exposures over time, detectors, resolution and contrast."""
