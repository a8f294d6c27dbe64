"""Reports of exposures."""
