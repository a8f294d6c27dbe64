"""Surfaces, systems, segments, pupils, wavefronts (lengths in mm)."""
