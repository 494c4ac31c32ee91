"""The Operational Digital Twin: the health of each unit, followed flight by flight."""
