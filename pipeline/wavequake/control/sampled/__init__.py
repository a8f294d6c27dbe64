"""Loops between instants: actuators move continuously, sensors average over frames, commands come late."""
