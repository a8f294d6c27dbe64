"""Sensors, actuators and controllers of a study, each kind one file beside its section of the study file."""
