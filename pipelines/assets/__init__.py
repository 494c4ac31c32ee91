"""The stages of the chain, one a module, each asset one call into `hdt_core`."""
