"""Lists of flights as `raw_flights` has them, made by hand: aircraft that fly some legs a day."""

from datetime import UTC, datetime, timedelta

import polars as pl

from hdt_core.record.exchange import BETWEEN_PACKS
from hdt_core.tables.raw import RawFlights

START = datetime(2024, 3, 4, 6, tzinfo=UTC)
NOW = datetime(2026, 11, 1, tzinfo=UTC)


def flight(tail: str, departed_at: datetime, leg: int, number: int = 0, **facts: object) -> dict[str, object]:
    """One flight of an hour and a half with contents of its own; `facts` replace its columns."""
    usual = {
        "operator": "AQX", "tail": tail, "flight_id": f"{tail}_{departed_at:%Y%m%d}_{leg:02d}",
        "departed_at": departed_at, "landed_at": departed_at + timedelta(minutes=90), "source": "acms",
        "n_snapshots": 40, "n_seconds": 0, "first_altitude_m": 800.0, "last_altitude_m": 900.0,
        "highest_altitude_m": 11_000.0, "mean_altitude_m": 8_000.0 + number, "first_mach": 0.3, "last_mach": 0.3,
        "highest_mach": 0.8, "mean_tat_k": 250.0 + 0.01 * number, "mean_hx_in_k": 380.0 + 0.01 * number,
        "n_values": 600, "clock_back_s": 0, "n_steps_back": 0, **dict.fromkeys(BETWEEN_PACKS),
    }  # fmt: skip
    return usual | facts


def fleet(n_days: int = 30, n_aircraft: int = 4, legs: int = 3) -> pl.DataFrame:
    """Aircraft that fly some legs each day, four hours apart."""
    rows = [
        flight(
            f"LX-AA{a}", START + timedelta(days=day, hours=4 * leg, minutes=7 * a), leg + 1, 100 * day + 10 * a + leg
        )
        for a in range(n_aircraft)
        for day in range(n_days)
        for leg in range(legs)
    ]
    return listed(rows)


def listed(rows: list[dict[str, object]]) -> pl.DataFrame:
    """Rows in the columns of `raw_flights`."""
    return RawFlights.conform(pl.DataFrame(rows, infer_schema_length=None))
