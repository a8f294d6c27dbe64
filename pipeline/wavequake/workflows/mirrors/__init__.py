"""Workflows of one deformable mirror: reduced models, their light over frequency and time."""
