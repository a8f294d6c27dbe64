"""Workflows that expose images over time."""
