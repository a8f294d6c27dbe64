"""Images of a study: point spread functions, exposures, extended objects, as sections of its file."""
