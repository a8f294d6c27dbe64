"""Loops of a sensor that averages over frames and a mirror that holds commands: exact covariance, no steps."""
