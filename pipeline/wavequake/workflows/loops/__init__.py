"""Closed loops: controllers and the models that they were designed on."""
