"""Segmented telescopes: glass, states, traces, wavefronts and their modal model."""
