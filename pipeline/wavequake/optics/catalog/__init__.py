"""Bundled optical systems by name."""
