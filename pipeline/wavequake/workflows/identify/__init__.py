"""Models from measurements: lines in telemetry, what moves, and a study that does the same."""
