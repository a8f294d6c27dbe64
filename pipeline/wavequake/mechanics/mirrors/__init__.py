"""Built-in finite-element models of mirrors."""
