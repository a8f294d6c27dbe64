"""Reports of reduced models of mirrors."""
