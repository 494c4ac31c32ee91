"""A night: which cells are stale, in which runs they are made, by whom, and what came of them."""
