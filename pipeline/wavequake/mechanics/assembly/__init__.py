"""Bodies, what joins them, and the plant that they are together: from forces and floor motion to optics."""
