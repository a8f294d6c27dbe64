"""Extended objects and how their images form."""
