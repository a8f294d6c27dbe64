"""Firmware of the lens experiment: gains as C headers, images, and emulated boards that run them."""
