"""Pupil functions: outlines, coverage, phases, sampling."""
