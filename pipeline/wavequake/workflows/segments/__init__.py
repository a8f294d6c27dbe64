"""Workflows of segmented telescopes: disturbances, modal and reduced models of segments."""
