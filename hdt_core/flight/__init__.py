"""Flights on record: phases, sample quality, steady state, and nominal legs."""
