"""What the maintenance log says of new and washed parts, flight by flight."""

import numpy as np
import polars as pl

from hdt_core.twin.crossing import PACK, Array

LOG_WINDOW_DAYS = 1
NOTHING, WASHED, REPLACED = range(3)


def log_flags(flights: pl.DataFrame, maintenance: pl.DataFrame, component: str) -> tuple[Array, Array]:
    """Where the log speaks of a component: on flights about the entry's day (open), and on the first flight after
    (due).

    `WASHED` or `REPLACED`, else `NOTHING`; `flights` stand in order (`crossing.IN_ORDER`). An entry may be days late:
    that is for the filter to see. An entry from before a pack's first flight says nothing: how long the part flew until
    the record begins is not known.
    """
    log_open, log_due = np.zeros(flights.height, dtype=np.int64), np.zeros(flights.height, dtype=np.int64)
    entries = maintenance.filter(
        (pl.col("component") == component)
        & pl.col("action").is_in(["REPLACED", "CLEANED"])
        & pl.col("done_on").is_not_null()
    )
    if not entries.height or not flights.height:
        return log_open, log_due
    day = flights["departed_at"].dt.date().to_numpy()
    start, last = 0, {}
    for *pack, n in flights.group_by(PACK, maintain_order=True).len().rows():
        last[tuple(pack)] = (start, start + n)
        start += n
    for *pack, done_on, action in entries.select(*PACK, "done_on", "action").rows():
        first, end = last.get(tuple(pack), (0, 0))
        window = np.datetime64(done_on) + np.arange(LOG_WINDOW_DAYS + 1)
        if first == end or day[first] > window[-1]:
            continue
        kind = WASHED if action == "CLEANED" else REPLACED
        near = slice(
            first + np.searchsorted(day[first:end], window[0]),
            first + np.searchsorted(day[first:end], window[-1], "right"),
        )
        log_open[near] = np.maximum(log_open[near], kind)
        due = first + int(np.searchsorted(day[first:end], window[0], "right"))
        if due < end:
            log_due[due] = max(int(log_due[due]), kind)
    return log_open, log_due
