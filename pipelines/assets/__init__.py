"""Stages of the chain as Dagster assets, each one call into `hdt_core`."""
