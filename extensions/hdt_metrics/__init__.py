"""Figures of the last night for a monitoring system: the command `hdt metrics`."""
