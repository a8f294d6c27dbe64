"""Reports of the lens bench."""
