"""Methods of reduction: every module registers its own."""
