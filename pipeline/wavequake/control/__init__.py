"""State-space control, and the oscillating lens bench with its sensor, stage, camera and controllers."""
