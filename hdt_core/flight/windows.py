"""Flights for calibration: the first of each tail, none around maintenance or a message."""

import polars as pl

from hdt_core.components.compressor import CC
from hdt_core.components.exchanger import HX
from hdt_core.records.keys import AIRCRAFT, FLIGHT, PACK

# flights of the tail before an entry that may be sick, and after it that may still be: entries come up to five
# flights late
AROUND_MAINTENANCE = {**{c.code: c.around_work for c in (HX, CC)}, "RAM_DOOR": (15, 1), "SENSOR": (15, 1)}
# messages of the pack's own exchanger and compressor; others (trim air, cabin fans) do not concern it
AROUND_MESSAGE = {str(HX.message_code)[:5]: (10, 5), str(CC.message_code)[:5]: (10, 5)}
# an inspection changes nothing, and the flights around a wash show by themselves how foul the exchanger was
HARMLESS = ("INSPECTED", "CLEANED")
LONGEST_PAUSE = "21d"
MILESTONES = (10, 20, 40, 80, 160)
"""Flights of a tail after which its baseline is extended; the last ends the commissioning window. Later flights are
never calibrated on, or slow wear would be learned as normal."""


def baseline_flights(flights: pl.DataFrame) -> list[str]:
    """Return the flights to calibrate on: the first of each tail, up to the last milestone it has passed.

    Parameters
    ----------
    flights : DataFrame
        `operator, tail, flight_id, departed_at`; more columns and rows (packs) are allowed.

    Returns
    -------
    list of str
        Sorted flight ids. A tail short of the first milestone contributes all. The result does not depend on the order
        in which flights arrived.
    """
    each = flights.group_by(FLIGHT).agg(pl.col("departed_at").min())
    order = pl.struct("departed_at", "flight_id").rank("ordinal").over(AIRCRAFT)
    milestone = pl.max_horizontal(pl.when(pl.len().over(AIRCRAFT) >= m).then(m) for m in MILESTONES)
    return sorted(each.filter(order <= milestone.fill_null(MILESTONES[0]))["flight_id"].to_list())


def number_flights(legs: pl.DataFrame) -> pl.DataFrame:
    """Add `flight_number`: the tail's flights in order of departure, from 0, the same for both packs."""
    order = pl.col("departed_at").rank("dense").over(AIRCRAFT).cast(pl.Int64) - 1
    return legs.with_columns(order.alias("flight_number"))


def flag_windows(legs: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame) -> pl.DataFrame:
    """Add `near_maintenance` and `near_message` (bool) for flights within the windows above.

    Parameters
    ----------
    legs : DataFrame
        `operator`, `tail`, `pack`, `departed_at`, `flight_number`.
    maintenance : DataFrame
        `operator`, `tail`, `done_on` (Date), `done_at` where the log gives times of day, `pack`, `component`, `action`.
        Inspections alone change nothing and open no window.
    messages : DataFrame
        `operator`, `tail`, `message_time`, `pack`, `code`.
    """
    times = [c for c in ("done_at", "done_on") if c in maintenance.columns]
    work = maintenance.filter(~pl.col("action").is_in(HARMLESS)).select(
        *AIRCRAFT,
        pl.col("pack").cast(pl.Int32),
        pl.coalesce(pl.col(c).cast(pl.Datetime("us", "UTC")) for c in times).alias("at"),
        pl.col("component").alias("kind"),
    )
    warnings = messages.select(
        *AIRCRAFT,
        pl.col("pack").cast(pl.Int32),
        pl.col("message_time").cast(pl.Datetime("us", "UTC")).alias("at"),
        pl.col("code").str.slice(0, 5).alias("kind"),
    )
    rows = _flag(legs, work, AROUND_MAINTENANCE, "near_maintenance")
    return _flag(rows, warnings, AROUND_MESSAGE, "near_message")


def _flag(legs: pl.DataFrame, entries: pl.DataFrame, reach: dict[str, tuple[int, int]], name: str) -> pl.DataFrame:
    """Flag the pack's flights within `reach` (flights before, flights after) of an entry of that kind."""
    spans = pl.DataFrame(
        {"kind": list(reach), "_before": [b for b, _ in reach.values()], "_after": [a for _, a in reach.values()]},
        schema={"kind": pl.String, "_before": pl.Int64, "_after": pl.Int64},
    )
    flights = legs.select(*AIRCRAFT, "departed_at", "flight_number").unique().sort("departed_at")
    entry_spans = entries.join(spans, on="kind", validate="m:1").sort("at")
    # the last flight before the entry; an entry during a long pause concerns no flight
    last_flights = entry_spans.join_asof(
        flights, left_on="at", right_on="departed_at", by=AIRCRAFT, tolerance=LONGEST_PAUSE, check_sortedness=False
    ).drop_nulls("flight_number")
    last = pl.col("flight_number")
    span = pl.int_ranges(last - pl.col("_before"), last + pl.col("_after") + 1).alias("flight_number")
    flight_rows = last_flights.select(*AIRCRAFT, "pack", span).explode("flight_number").unique()
    hits = flight_rows.with_columns(pl.lit(True).alias(name))
    rows = legs.join(hits, on=[*PACK, "flight_number"], how="left", maintain_order="left", validate="m:1")
    return rows.with_columns(pl.col(name).fill_null(False))
