"""Reports of any optical system."""
