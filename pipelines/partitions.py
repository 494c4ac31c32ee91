"""Partitions: aircraft x flight below, aircraft above, the fleet on top."""

import dagster as dg

AIRCRAFT = dg.DynamicPartitionsDefinition(name="aircraft")
FLIGHTS = dg.DynamicPartitionsDefinition(name="flight")
AIRCRAFT_FLIGHTS = dg.MultiPartitionsDefinition({"aircraft": AIRCRAFT, "flight": FLIGHTS})


def aircraft_key(operator: str, tail: str) -> str:
    """Partition key of an aircraft."""
    return f"{operator}:{tail}"


def flight_key(flight_id: str) -> str:
    """Partition key of a flight, `YYYYMMDD_LEG`, shared by all aircraft."""
    return flight_id[-11:]


def cell_key(aircraft: str, flight: str) -> dg.MultiPartitionKey:
    """Partition key of an aircraft's flight, of their own keys."""
    return dg.MultiPartitionKey({"aircraft": aircraft, "flight": flight})


def aircraft_of(key: str) -> tuple[str, str]:
    """Operator and tail of an aircraft's key."""
    operator, tail = key.split(":", 1)
    return operator, tail


def cell_of(key: str) -> tuple[str, str, str]:
    """Operator, tail and flight id of an aircraft x flight key."""
    aircraft, flight = key.split("|", 1)
    operator, tail = aircraft_of(aircraft)
    return operator, tail, f"{tail}_{flight}"
