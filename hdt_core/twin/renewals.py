"""What the maintenance log says of new and washed parts, flight by flight."""

import numpy as np
import polars as pl

from hdt_core.twin.crossing import PACK, Array

LOG_WINDOW_DAYS = 1
NOTHING, WASHED, REPLACED = range(3)


def log_flags(flights: pl.DataFrame, maintenance: pl.DataFrame, component: str) -> tuple[Array, Array]:
    """Where the log speaks of a component: on flights about the entry's day (open), and on the first flight after
    (due).

    `WASHED` or `REPLACED`, else `NOTHING`. An entry may be days late: that is for the filter to see. An entry from
    before a pack's first flight says nothing: how long the part flew until the record begins is not known.
    """
    log_open, log_due = np.zeros(flights.height, dtype=np.int64), np.zeros(flights.height, dtype=np.int64)
    entries = maintenance.filter(
        (pl.col("component") == component)
        & pl.col("action").is_in(["REPLACED", "CLEANED"])
        & pl.col("done_on").is_not_null()
    )
    if not entries.height or not flights.height:
        return log_open, log_due
    rows = (
        flights.with_row_index("row")
        .group_by(PACK, maintain_order=True)
        .agg("row", pl.col("departed_at").dt.date().alias("day"))
    )
    met = entries.select(*PACK, "done_on", "action").join(rows, on=PACK)
    for entry in met.iter_rows(named=True):
        kind = WASHED if entry["action"] == "CLEANED" else REPLACED
        index, day = np.array(entry["row"]), np.array(entry["day"], dtype="datetime64[D]")
        after = (day - np.datetime64(entry["done_on"])).astype(int)
        if after.min() > LOG_WINDOW_DAYS:
            continue
        near = index[(after >= 0) & (after <= LOG_WINDOW_DAYS)]
        log_open[near] = np.maximum(log_open[near], kind)
        later = index[after > 0]
        if len(later):
            log_due[later[0]] = max(int(log_due[later[0]]), kind)
    return log_open, log_due
