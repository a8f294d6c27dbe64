"""Sequential optical systems: surfaces, stop, fields; study files, kinematics, first-order optics."""
