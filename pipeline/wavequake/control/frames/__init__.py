"""Loops of a sensor that averages over frames and a mirror that holds commands, without steps in time."""
