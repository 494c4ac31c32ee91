"""The Digital System Model: how each aircraft was built, found on its nominal flights."""
