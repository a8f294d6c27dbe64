"""Quantiles and goals over the cases of a store, by blocks."""
