"""The digital system model and its operational twin: calibrate, estimate each flight, track health."""
