"""Flag flights on which the maintenance log renews or washes parts."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl

from hdt_core.records.keys import AIRCRAFT, PACK
from hdt_core.records.unit_index import date_entries, first_flights, select_entries

Flags = npt.NDArray[Any]
LOG_WINDOW = pl.duration(days=1)
NOTHING, WASH, REPLACEMENT = range(3)
RENEWALS = ("REPLACED", "CLEANED")


def log_flags(
    flights: pl.DataFrame, maintenance: pl.DataFrame, component: str, actions: Sequence[str] = RENEWALS
) -> tuple[Flags, Flags]:
    """Flag a component's log entries: on flights within a day of an entry's moment (open), and on the first flight that
    counts as flown after it (due); the moment is that of `records.unit_index`.

    `REPLACEMENT`, `WASH` after another of `actions`, else `NOTHING`; `flights` stand in order (`keys.IN_ORDER`). An
    entry may be days late: the filter models that. An entry before a pack's first flight is ignored, for the part's age
    when the record begins is unknown.
    """
    row = pl.int_range(pl.len())
    rows = flights.select(*PACK, "departed_at", row=row, begins=row == row.min().over(PACK))
    entries = select_entries(maintenance, (component,), actions)
    delay = pl.col("departed_at") - pl.col("counts_from")
    near = entries.join(rows, on=PACK, validate="m:m").filter((delay >= -LOG_WINDOW) & (delay < LOG_WINDOW))
    due = first_flights(rows, maintenance, (component,), actions).filter(~pl.col("begins") | (delay < LOG_WINDOW))
    return _flags(near, flights.height), _flags(due, flights.height)


def log_kept(flights: pl.DataFrame, maintenance: pl.DataFrame) -> Flags:
    """Flag flights after the first log entry within the aircraft's record, for any part: before it the lack of an entry
    means nothing, since some operators send no log. (n,) bool"""
    begins = flights.group_by(AIRCRAFT).agg(pl.col("departed_at").min().alias("begins"))
    entries = date_entries(maintenance).join(begins, on=AIRCRAFT, validate="m:1")
    first = (
        entries.filter(pl.col("counts_from") >= pl.col("begins")).group_by(AIRCRAFT).agg(pl.col("counts_from").min())
    )
    rows = flights.select(*AIRCRAFT, "departed_at").join(
        first, on=AIRCRAFT, how="left", maintain_order="left", validate="m:1"
    )
    return rows.select((pl.col("departed_at") >= pl.col("counts_from")).fill_null(False))[:, 0].to_numpy()


def _flags(entries: pl.DataFrame, n: int) -> Flags:
    flags: Flags = np.full(n, NOTHING)
    kind = np.where(entries["action"].to_numpy() == "REPLACED", REPLACEMENT, WASH)
    np.maximum.at(flags, entries["row"].to_numpy(), kind)
    return flags
