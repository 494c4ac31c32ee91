"""A shadow trial: what is said each night is sealed before outcomes are known, and one page says how it went."""
