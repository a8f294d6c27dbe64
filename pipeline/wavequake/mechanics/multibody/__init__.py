"""Elastic bodies that are joined, free, rotating or in large motion."""
