"""Note flights that were on the ground in between, or whose reports are hours apart."""

from collections.abc import Sequence
from typing import Any

import polars as pl

from hdt_core.record.facts import SILENCE_S, ground_stops
from pipelines.intake.faults import Fault


def note_silences(rows: pl.DataFrame, key: Sequence[str]) -> list[tuple[Any, Fault]]:
    """Make a note for each flight that was on the ground in between, or whose reports are hours apart.

    The clock was set during a flight of the second kind.

    Parameters
    ----------
    rows : DataFrame
        `key`, `time_utc`, `altitude_m`, `mach`.
    key : sequence of str
        Columns of the file, which is returned beside its note, and of the flight.
    """
    stops = ground_stops(rows, key)
    notes = [
        (file, Fault("two_legs", None, "report_time", f"Nothing in the air for {s // 60} minutes.", flight_id=flight))
        for file, flight, s in stops.iter_rows()
    ]
    longest = pl.col("time_utc").sort().diff().max().alias("silence")
    flights = (
        rows.group_by(key)
        .agg(longest)
        .filter(pl.col("silence").dt.total_seconds() > SILENCE_S)
        .join(stops, on=key, how="anti")
    )
    return notes + [
        (file, Fault("clock_jump", None, "report_time", f"Longest silence: {silence}.", flight_id=flight))
        for file, flight, silence in flights.sort(key).iter_rows()
    ]
