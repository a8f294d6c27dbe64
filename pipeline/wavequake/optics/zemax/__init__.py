"""Zemax's sequential lens files: reading and writing."""
