"""Results at nodes that other programs write: displacements over time or per load case, and modes."""
