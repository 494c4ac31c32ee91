"""What messages cost to avoid: an exchanger is renewed on the first flight on which a signal passes a limit.

Three signals side by side: the forecast, the loss alone, and the flights since the unit was new (a fixed interval). The
limit of a month is that which would have avoided `AVOIDED_SHARE` of the messages known when the month began, as an
operator would have to choose it; one limit for all types.
"""

from datetime import UTC, date, datetime
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.harness import markdown
from hdt_core.prognosis.metrics import CAP
from hdt_core.records.keys import LEG, PACK

SIGNALS = {"forecast": "p_event_100", "limit on the loss": "loss", "fixed interval": "age"}
AVOIDED_SHARE = 0.8
NOTICE_FLIGHTS = 10
"""A renewal avoids a message that comes at least so many flights later: the part has to be at hand."""
LEAST_MESSAGES = 10
"""Messages known from which on a limit is chosen."""
ALL = "all"


class Price(NamedTuple):
    """What a limit on a signal costs."""

    avoided: float
    """Share of the messages avoided."""
    given_up_flights: float
    """Flights until the message that was avoided, at most 300; the median."""
    unneeded: float
    """Renewals of units that flew 300 flights more without a message, for each message avoided."""


def with_signals(outcomes: pl.DataFrame, features: pl.DataFrame, group: str) -> pl.DataFrame:
    """Return prognoses of `join_outcomes` with their signals, and the group of types that their fleet belongs to."""
    loss = features.select(*LEG, loss=pl.col("hx_fouling").fill_nan(None).fill_null(0.0))
    rows = outcomes.filter(pl.col("p_event_100").is_not_null()).join(loss, on=LEG, validate="1:1")
    ordered = rows.sort(*PACK, "life", "departed_at")
    age = pl.int_range(pl.len()).over(*PACK, "life").cast(pl.Float64)
    columns = (*PACK, "life", "departed_at", "remaining", "failed", "p_event_100", "loss")
    return ordered.select(*columns, age=age, group=pl.lit(group))


def prices(fleets: list[pl.DataFrame]) -> dict[str, dict[str, Price]]:
    """Price every signal, for each group of types and for `ALL`, from the first month with a limit on.

    Parameters
    ----------
    fleets : list of DataFrame
        Of `with_signals`.
    """
    rows = pl.concat(fleets).with_columns(
        life=pl.struct(*PACK, "life").rle_id(), month=pl.col("departed_at").dt.month_start().dt.date()
    )
    priced = {}
    for name, signal in SIGNALS.items():
        with_limit = rows.join(rolling_limits(rows, signal), on="month", validate="m:1", maintain_order="left")
        marked = with_limit.with_columns(passed=pl.col(signal) >= pl.col("limit"))
        groups = {ALL: marked} | {str(group): part for (group,), part in marked.group_by("group", maintain_order=True)}
        priced[name] = {group: price(part) for group, part in groups.items()}
    return priced


def rolling_limits(rows: pl.DataFrame, signal: str) -> pl.DataFrame:
    """Choose the limit of each month in which `LEAST_MESSAGES` were known when it began; columns month, limit."""
    chosen = []
    for month in rows["month"].unique().sort():
        known = as_of(rows, month)
        if known.filter("failed")["life"].n_unique() >= LEAST_MESSAGES:
            chosen.append((month, choose_limit(known, signal)))
    return pl.DataFrame(chosen, schema={"month": pl.Date, "limit": pl.Float64}, orient="row")


def as_of(rows: pl.DataFrame, day: date) -> pl.DataFrame:
    """Return the rows before a day, with what was known of their lives by then."""
    past = rows.filter(pl.col("departed_at") < datetime(day.year, day.month, day.day, tzinfo=UTC))
    flights_known = (pl.len() - pl.int_range(pl.len())).over("life").cast(pl.Float64)
    return past.with_columns(
        failed=pl.col("failed") & (pl.col("remaining") <= flights_known),
        remaining=pl.min_horizontal("remaining", flights_known),
    )


def choose_limit(rows: pl.DataFrame, signal: str) -> float:
    """Choose the highest limit that avoids `AVOIDED_SHARE` of the messages."""
    in_time = pl.when(pl.col("remaining") >= NOTICE_FLIGHTS).then(signal)
    highest = rows.filter("failed").group_by("life").agg(signal=in_time.max())["signal"].fill_null(-np.inf)
    n_avoided = int(np.ceil(AVOIDED_SHARE * highest.len()))
    return float(highest.sort(descending=True)[n_avoided - 1])


def price(rows: pl.DataFrame) -> Price:
    """Price renewals on each life's first flight with the mark `passed`."""
    failures = rows.filter("failed")["life"].n_unique()
    renewed = rows.filter("passed").unique("life", keep="first", maintain_order=True)
    avoided = renewed.filter("failed", pl.col("remaining") >= NOTICE_FLIGHTS)["remaining"].clip(0.0, CAP)
    unneeded = renewed.filter(~pl.col("failed"), pl.col("remaining") >= CAP).height
    if not avoided.len():
        return Price(0.0, np.nan, np.nan)
    return Price(avoided.len() / failures, float(np.median(avoided)), unneeded / avoided.len())


def table(priced: dict[str, dict[str, Price]]) -> str:
    """Return a row for each signal and group of types."""
    lines = [["renewed by", "types", "messages avoided", "flights given up, median", "unneeded for each avoided"]]
    for name, groups in priced.items():
        for group, cost in groups.items():
            lines.append([name, group, f"{cost.avoided:.2f}", f"{cost.given_up_flights:.0f}", f"{cost.unneeded:.2f}"])
    return markdown(lines)
