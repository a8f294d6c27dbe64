"""Shapes of surfaces: sag, polynomials and grids on them, polygons of glass, and fits of moved nodes."""
