"""This installation against named peers that do the same work: the oscillator of the paper, fleets of exchangers."""
