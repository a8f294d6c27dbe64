"""The lens bench and its controllers."""
