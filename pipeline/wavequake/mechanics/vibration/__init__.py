"""Vibration of linear models: modes, damping, excitation, exact response."""
