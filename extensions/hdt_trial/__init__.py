"""Shadow trial: each night's alerts are sealed before outcomes are known and evaluated on one page."""
