"""The Digital System Model: the design of each aircraft, calibrated on its nominal flights."""
