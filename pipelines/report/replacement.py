"""The replacement that Figure 16 is drawn around."""

from typing import Any

import polars as pl

from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries

FLIGHTS_BEFORE, FLIGHTS_AFTER = 200, 40


def around_replacement(flights: pl.DataFrame, maintenance: pl.DataFrame) -> tuple[dict[str, Any], pl.DataFrame] | None:
    """The replacement of an exchanger with the deepest loss before it, and the flights around it.

    Parameters
    ----------
    flights : DataFrame
        Sorted by departure; `ua_share` is the measured conductance over the expected one.
    maintenance : DataFrame
        The log of work.

    Returns
    -------
    dict and DataFrame, or None
        The line of the log; its pack's flights with `n`, counted from 0 at the first flight after it.
    """
    best: tuple[float, dict[str, Any], pl.DataFrame] | None = None
    work = date_entries(maintenance.filter(component="HX", action="REPLACED").drop_nulls("pack"))
    worked_on = flights.join(work, on=PACK, how="semi", maintain_order="left").partition_by(PACK, as_dict=True)
    for w in work.to_dicts():
        own = worked_on.get(tuple(w[k] for k in PACK), flights.clear())
        before = own["departed_at"] < w["counts_from"]
        rows = own.with_columns(n=pl.int_range(pl.len()) - int(before.sum())).filter(
            pl.col("n").is_between(-FLIGHTS_BEFORE, FLIGHTS_AFTER)
        )
        level = pl.col("ua_share").log().median()
        after, last = rows.filter(pl.col("n") >= 0).select(level), rows.filter(pl.col("n") < 0).tail(20).select(level)
        gained = after.item() - last.item() if after.item() is not None and last.item() is not None else None
        if gained is not None and rows.filter(pl.col("n") < 0).height >= 20 and (best is None or gained > best[0]):
            best = gained, w, rows
    return None if best is None else best[1:]
