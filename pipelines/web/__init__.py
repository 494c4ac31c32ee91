"""Dagster's page behind its gate."""
