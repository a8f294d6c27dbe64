"""What a run would take: said in time, from a pilot or from what is known."""
