"""Compute the cases of a campaign: chunks, tasks, scheduling, isolation."""
