"""State-space control, and the oscillating lens bench with its sensor, stage, camera and controllers.

SciPy solves Riccati equations, exponentials and pole placement; python-control, which calls SciPy for them,
would add the import of Matplotlib to every worker, and is what the tests compare with.
"""
