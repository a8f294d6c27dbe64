"""Reports of segmented telescopes."""
