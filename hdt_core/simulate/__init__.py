"""Fleets with known truth: lives to learn from, and raw recordings to test with."""
