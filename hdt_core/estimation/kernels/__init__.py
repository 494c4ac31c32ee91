"""Compiled inner loops. Each has a NumPy path beside it and a test that both give the same answer."""
