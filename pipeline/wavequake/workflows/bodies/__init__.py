"""Bodies of mass in study files, whatever the optics: sections, files, and the plant that they make."""
