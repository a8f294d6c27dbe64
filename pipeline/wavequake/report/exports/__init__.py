"""Stores and cases as files of other programs."""
