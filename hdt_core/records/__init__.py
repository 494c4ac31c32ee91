"""Queries on a fleet's records that many modules share."""
