"""Reports of closed loops."""
