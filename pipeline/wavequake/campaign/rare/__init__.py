"""Probabilities of rare events of functions of Gaussian numbers; no physics."""
