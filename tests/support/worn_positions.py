"""Losses of an aircraft's positions from flight to flight, and a maintenance log that is judged by them."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

from hdt_core.records.recoveries import judge_work

START = datetime(2024, 1, 1, tzinfo=UTC)
PACK = {"operator": "AAA", "tail": "T-1"}
FLIGHTS = 120
RENEWED = 60
"""Flight from which the worn pack is clean; there is a flight each eight hours."""
WORN = np.where(np.arange(FLIGHTS) < RENEWED, 0.3, 0.01)
CLEAN = np.full(FLIGHTS, 0.02)


def departure(flight: int) -> datetime:
    return START + timedelta(hours=8 * flight)


def fly(*losses: np.ndarray, sd: float = 0.01) -> pl.DataFrame:
    """Flights of packs 1, 2 ... with these losses."""
    parts = [
        pl.DataFrame({"departed_at": [departure(k) for k in range(loss.size)], "loss": loss}).with_columns(
            **{name: pl.lit(value) for name, value in PACK.items()},
            pack=pl.lit(pack, pl.Int32),
            loss_sd=sd,
            row=pl.int_range(loss.size),
        )
        for pack, loss in enumerate(losses, 1)
    ]
    return pl.concat(parts)


def log(*entries: tuple[int, int], action: str = "REPLACED") -> pl.DataFrame:
    """Entries by pack and the first flight after the work."""
    rows = [{**PACK, "pack": pack, "component": "HX", "action": action, "done_on": departure(k).date(),
             "done_at": departure(k)} for pack, k in entries]  # fmt: skip
    return pl.DataFrame(rows).with_columns(pl.col("pack").cast(pl.Int32))


def messages_after(*flights: int) -> pl.DataFrame:
    rows = [{**PACK, "pack": 1, "message_time": departure(k)} for k in flights]
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "message_time": pl.Datetime("us", "UTC")}
    return pl.DataFrame(rows, schema=schema)


def judge(flights: pl.DataFrame, entries: pl.DataFrame, messages: pl.DataFrame | None = None) -> pl.DataFrame:
    messages = messages_after() if messages is None else messages
    return judge_work(flights, entries, messages, "HX", ("REPLACED", "CLEANED")).sort("counts_from")
