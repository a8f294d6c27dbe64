"""Rays over the pupil: where they start, how they meet the stop, and what the trace takes."""
