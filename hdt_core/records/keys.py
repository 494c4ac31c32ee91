"""Columns that name what a row is about, in the order in which tables are sorted by them."""

AIRCRAFT = ["operator", "tail"]
FLIGHT = [*AIRCRAFT, "flight_id"]
PACK = [*AIRCRAFT, "pack"]
FLIGHT_PACK = [*PACK, "flight_id"]
IN_ORDER = [*PACK, "departed_at", "flight_id"]
"""Flights of a pack as flown; the id settles what departs at one instant in a made-up file."""
LEG = [*FLIGHT, "pack"]
LEG_AT = [*LEG, "departed_at"]
