"""What many parts of the twin ask of a fleet's records, answered in one place."""
