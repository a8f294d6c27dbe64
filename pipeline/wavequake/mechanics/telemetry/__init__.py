"""Measured signals of a vibrating instrument: records, spectra, and the lines in them."""
