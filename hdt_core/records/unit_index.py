"""Number the units of each position by the maintenance log, for every component.

A flight flies with a new (or repaired) part if it departs at or after the moment from which the entry of the
maintenance log counts. An entry with a time of day counts from that time. An entry with a day alone counts from the end
of that day (24:00 UTC), so that the flights of the day itself still belong to the part that came off.

A log is seldom early but may be some flights late. Counted from its end, the day gives no flight of the old part to
the new one, whose clean level, trend and age would be wrong for all of its life; the price is a few flights of the new
part at the end of a life that is over. See `docs/calibration.md` for how often either happens.
"""

from collections.abc import Sequence

import numpy as np
import polars as pl

from hdt_core.records.keys import AIRCRAFT, PACK
from hdt_core.robust import Array
from hdt_core.tables.base import UTC

NEW_UNIT = ("REPLACED",)
"""Actions after which another unit flies; a wash keeps the unit."""


def date_entries(maintenance: pl.DataFrame) -> pl.DataFrame:
    """Add `counts_from` (UTC) to the log, the moment from which each entry counts.

    Parameters
    ----------
    maintenance : DataFrame
        `done_on` (Date) and, where the log gives a time of day, `done_at` (UTC, null where it gives none).
    """
    day_ends = (pl.col("done_on") + pl.duration(days=1)).cast(UTC)
    times = [pl.col(c).cast(UTC) for c in ("counts_from", "done_at") if c in maintenance.columns]
    return maintenance.with_columns(pl.coalesce(*times, day_ends).alias("counts_from"))


def select_entries(maintenance: pl.DataFrame, components: Sequence[str], actions: Sequence[str]) -> pl.DataFrame:
    """Select work of a kind, each pack, moment and action once: `PACK`, `action`, `counts_from`; by moment."""
    is_selected = pl.col("component").is_in(components) & pl.col("action").is_in(actions) & pl.col("pack").is_not_null()
    entries = date_entries(maintenance).filter(is_selected & pl.col("counts_from").is_not_null())
    entries = entries.select(*AIRCRAFT, pl.col("pack").cast(pl.Int32), "action", "counts_from")
    return entries.unique().sort("counts_from", *PACK, "action")


def number_units(
    flights: pl.DataFrame,
    maintenance: pl.DataFrame,
    component: str = "HX",
    name: str = "unit",
    actions: Sequence[str] = NEW_UNIT,
) -> pl.DataFrame:
    """Add `name`: the number of replacements of the component (or other `actions`) before the flight, by the log.

    Work that turned out not to have been done counts until then, its `until` where the log has such a column.

    Parameters
    ----------
    flights : DataFrame
        `PACK`, `departed_at` and what else is to be kept; comes back sorted by departure.
    maintenance : DataFrame
        `PACK`, `component`, `action`, and what `date_entries` reads.
    """
    begins = select_entries(maintenance, (component,), actions).select(*PACK, "counts_from", change=1)
    ends = begins.clear()
    if "until" in maintenance.columns:
        ended = maintenance.drop_nulls("until").with_columns(counts_from="until")
        ends = select_entries(ended, (component,), actions).select(*PACK, "counts_from", change=-1)
    changes = pl.concat([begins, ends]).sort("counts_from", *PACK, "change")
    numbers = changes.select(*PACK, departed_at="counts_from", number=pl.col("change").cum_sum().over(PACK))
    numbers = numbers.rename({"number": name})
    rows = flights.sort("departed_at", maintain_order=True).join_asof(
        numbers, on="departed_at", by=PACK, check_sortedness=False
    )
    return rows.with_columns(pl.col(name).fill_null(0))


def first_flights(
    flights: pl.DataFrame, maintenance: pl.DataFrame, components: Sequence[str], actions: Sequence[str] = NEW_UNIT
) -> pl.DataFrame:
    """Join each entry of a kind with the first flight that counts as flown after it; drop entries without one.

    Returns
    -------
    DataFrame
        `PACK`, `action`, `counts_from`, and the other columns of `flights`.
    """
    entries = select_entries(maintenance, components, actions)
    flights = flights.sort("departed_at", maintain_order=True)
    return entries.join_asof(
        flights, left_on="counts_from", right_on="departed_at", by=PACK, strategy="forward", check_sortedness=False
    ).drop_nulls("departed_at")


LOG_WINDOW = pl.duration(days=1)
NOTHING, WASH, REPLACEMENT = range(3)
RENEWALS = ("REPLACED", "CLEANED")


def log_flags(
    flights: pl.DataFrame, maintenance: pl.DataFrame, component: str, actions: Sequence[str] = RENEWALS
) -> tuple[Array, Array]:
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


def log_kept(flights: pl.DataFrame, maintenance: pl.DataFrame) -> Array:
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


def _flags(entries: pl.DataFrame, n: int) -> Array:
    flags: Array = np.full(n, NOTHING)
    kind = np.where(entries["action"].to_numpy() == "REPLACED", REPLACEMENT, WASH)
    np.maximum.at(flags, entries["row"].to_numpy(), kind)
    return flags
