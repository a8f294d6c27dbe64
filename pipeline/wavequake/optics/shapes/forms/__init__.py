"""The shapes of the package, each in a file of its own; a file that is added here is known."""
