"""Remaining life with its interval, and the chance of a message soon."""
