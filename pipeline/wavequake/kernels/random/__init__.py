"""Random numbers that a counter addresses, on devices and by NumPy."""
