"""Flights under a wrong tail that are found, and right ones that are held: `python -m benchmarks.misfiled --write`.

A drawn flight is delivered under another aircraft of its operator, in a gap of that one's schedule, and not under its
own. What is right is judged as each day of the record ends, as the nights do. On simulated fleets, and on what homes
have stored: `--homes FOLDER FOLDER`.
"""

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import numpy as np
import polars as pl

from benchmarks.fleets import simulate_record
from benchmarks.harness import Texts, markdown, run
from benchmarks.record import PAGE
from hdt_core.record.facts import AIRPORTS, flight_facts
from hdt_core.record.misfiled import misfiled
from hdt_core.simulate.design import FleetSettings
from pipelines.storage.store import Store

SEED = 501
TAILS = (4, 8, 14, 25)
"""Aircraft of an operator in each simulated fleet."""
HEADINGS = ["aircraft an operator", "drawn", "found", "of the right aircraft", "right flights", "of these held"]


def main(draws: int = 200, flights: int = 200, tails: tuple[int, ...] = TAILS, homes: tuple[str, ...] = ()) -> Texts:
    """Draw flights under a wrong tail, and tabulate what is found by the size of the fleet."""
    rows = [_judge(own, draws) for own in (*_simulated(flights, tails), *_stored(homes))]
    yield "misfiled", markdown([HEADINGS, *rows])


def _simulated(n_flights: int, sizes: tuple[int, ...]) -> Iterator[pl.DataFrame]:
    """Simulate a fleet of two operators of each size: rows of `raw_flights`."""
    for tails in sizes:
        settings = FleetSettings(operators=2, tails=tails, flights=n_flights, cpl_share=0.0)
        snapshots = simulate_record(SEED + tails, settings)["snapshots"]
        unknown = (pl.lit(None, pl.String).alias(name) for name in AIRPORTS)
        in_file = pl.int_range(1, pl.len() + 1).over("flight_id").alias("row_in_file")
        yield flight_facts(snapshots.with_columns(*unknown, in_file, file=pl.col("flight_id")))


def _stored(homes: tuple[str, ...]) -> Iterator[pl.DataFrame]:
    for home in homes:
        yield Store(Path(home)).read_table("raw_flights")


def _judge(flights: pl.DataFrame, draws: int) -> list[str]:
    """Return a line of the table: what is found of the drawn flights of a fleet, and held of the right ones."""
    rng = np.random.default_rng(SEED)
    verdicts = [_find_one(rng, flights) for _ in range(draws)]
    n_found = sum(verdict is not None for verdict in verdicts)
    n_right = sum(verdict is True for verdict in verdicts)
    tails = flights.group_by("operator").agg(pl.col("tail").n_unique())["tail"].max()
    figures = (draws, f"{n_found / draws:.0%}", n_right, f"{flights.height:,}", len(_held_on_any_night(flights)))
    return [str(tails), *map(str, figures)]


def _find_one(rng: np.random.Generator, flights: pl.DataFrame) -> bool | None:
    """Misfile one flight; return whether the aircraft that flew it is named, None where the flight is not held."""
    while True:
        flight = flights[int(rng.integers(flights.height))]
        operator, tail, start, end = flight.select("operator", "tail", "departed_at", "landed_at").row(0)
        own = flights.filter(operator=operator)
        wrong_tail = str(rng.choice(own.filter(pl.col("tail") != tail)["tail"].unique().sort().to_list()))
        of_wrong = own.filter(tail=wrong_tail)
        n_before = of_wrong.filter(pl.col("landed_at") < start).height
        n_after = of_wrong.filter(pl.col("departed_at") > end).height
        if n_before and n_after and n_before + n_after == of_wrong.height:
            break
    wrong = flight.with_columns(tail=pl.lit(wrong_tail), flight_id=pl.lit("wrong"))
    others = own.filter((pl.col("tail") != tail) | (pl.col("departed_at") != start))
    held = misfiled(pl.concat([others, wrong])).filter(flight_id="wrong")
    return None if held.is_empty() else str(held["other_flight_id"].item()).startswith(tail)


def _held_on_any_night(flights: pl.DataFrame) -> set[str]:
    """Return the flights that are held when some day of the record has ended."""
    first, last = flights.select(first=pl.col("departed_at").min(), last=pl.col("departed_at").max()).row(0)
    ends = (first + timedelta(days=day) for day in range(1, (last - first).days + 2))
    return {flight for end in ends for flight in misfiled(flights.filter(pl.col("departed_at") < end))["flight_id"]}


if __name__ == "__main__":
    run(main, page=PAGE)
