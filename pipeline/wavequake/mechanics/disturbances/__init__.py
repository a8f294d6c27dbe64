"""Disturbances: what draws motion, spectra, histories and streams of random numbers."""
