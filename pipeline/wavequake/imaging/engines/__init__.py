"""Engines of point spread functions, and the choice between them."""
