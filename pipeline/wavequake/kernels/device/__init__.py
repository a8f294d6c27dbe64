"""Devices, programs, memory and launches."""
