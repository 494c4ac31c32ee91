"""Judge whose flight it is, when, and which leg, before any physics."""
