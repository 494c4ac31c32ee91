"""A night: find stale cells, group them into runs, execute the runs and report failures."""
