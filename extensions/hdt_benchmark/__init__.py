"""Speed of this installation against named peers: the paper's oscillator, fleets of exchangers."""
