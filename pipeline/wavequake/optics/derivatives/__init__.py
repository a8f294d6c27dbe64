"""Kinematic-optical sensitivities of any system."""
