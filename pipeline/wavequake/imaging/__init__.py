"""Point spread functions, exposures and measures of resolution."""
