"""Benchmarks: `python -m benchmarks.raytrace`, or all of them by `make bench`."""
