"""Deliveries become one truth: each flight, pack and time once, whoever delivered it, in whatever order."""

from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import NamedTuple

import polars as pl

from pipelines.intake.columns import PHASE, SI_NAMES
from pipelines.intake.ledger import QUARANTINE_SCHEMA, Fault, quarantine

KEY = ("operator", "source", "flight_id", "pack", "time_utc")
SAME = 1e-6
"""Relative difference below which two values are one value: a 32-bit float and the text it was printed from."""


class Merged(NamedTuple):
    """One row a key; for each file and flight how many rows said nothing new; the rows that said something else."""

    rows: pl.DataFrame
    duplicates: pl.DataFrame
    quarantine: pl.DataFrame


def merge_deliveries(frames: Iterable[pl.DataFrame], received_at: Mapping[str, datetime]) -> Merged:
    """Store each flight, pack and time once.

    Among rows of one key the one with most values wins, then the one whose values sort first: what is stored depends on
    what was delivered, never on when. A row that agrees with the winner, or holds less, is a duplicate; one that gives
    another value is kept aside as `conflicting_delivery`. Rows are judged against the winner, so all deliveries of a
    flight must be merged together.

    Parameters
    ----------
    frames : iterable of DataFrame
        Rows of `read_snapshots`.
    received_at : mapping
        When each file was received, for the quarantine.

    Returns
    -------
    Merged
        `rows` sorted by flight, time and pack; `duplicates` with `file, flight_id, n_duplicate`; `quarantine`.
    """
    rows = pl.concat(list(frames))
    repeated = rows.select(pl.struct(KEY).is_duplicated()).to_series()
    once, again = rows.filter(~repeated), rows.filter(repeated)
    won, lost = _contest(again)
    agreed, differing = _against(lost, won)
    duplicates = agreed.group_by("file", "flight_id").agg(pl.len().cast(pl.Int64).alias("n_duplicate"))
    return Merged(
        pl.concat([once, won]).sort("operator", "flight_id", "source", "time_utc", "pack"),
        duplicates.sort("file", "flight_id"),
        _conflicts(differing, received_at),
    )


def _contest(rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Of each key the row that wins, and those that lose."""
    n_values = pl.sum_horizontal(pl.col(c).is_not_null() for c in (*SI_NAMES, PHASE)).alias("n_values")
    order = (*KEY, "n_values", *SI_NAMES, PHASE, "file", "row_in_file")
    descending = [c == "n_values" for c in order]
    ranked = rows.with_columns(n_values).sort(order, descending=descending, nulls_last=True).drop("n_values")
    first = ranked.select(pl.struct(KEY).is_first_distinct()).to_series()
    return ranked.filter(first), ranked.filter(~first)


def _against(lost: pl.DataFrame, won: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Losers that agree with their winner in all they say, and those that do not, with `differs`."""
    pairs = lost.join(won.drop("tail"), on=KEY, how="left", suffix=" won", maintain_order="left")
    differs = [pl.when(~_agrees(c)).then(pl.lit(c)) for c in SI_NAMES]
    differs.append(
        pl.when(~pl.col(PHASE).eq(pl.col(f"{PHASE} won")).fill_null(pl.col(PHASE).is_null())).then(pl.lit(PHASE))
    )
    pairs = pairs.with_columns(pl.concat_list(differs).list.drop_nulls().list.join(", ").alias("differs"))
    agreed = pl.col("differs") == ""
    return pairs.filter(agreed), pairs.filter(~agreed)


def _agrees(column: str) -> pl.Expr:
    """Whether a loser's value is null or the winner's."""
    value, winner = pl.col(column), pl.col(f"{column} won")
    close = (value - winner).abs() <= SAME * pl.max_horizontal(value.abs(), winner.abs())
    return value.is_null() | close.fill_null(False)


def _conflicts(differing: pl.DataFrame, received_at: Mapping[str, datetime]) -> pl.DataFrame:
    faults: dict[str, list[Fault]] = {}
    places = ("file", "row_in_file", "flight_id", "differs", "file won", "row_in_file won")
    for file, row, flight, differs, won_file, won_row in differing.select(places).sort(places).iter_rows():
        detail = f"It conflicts with row {won_row} of {won_file}."
        faults.setdefault(file, []).append(Fault("conflicting_delivery", row, differs, detail, 1, flight))
    frames = [quarantine(file, received_at.get(file), found) for file, found in faults.items()]
    return pl.concat([pl.DataFrame(schema=QUARANTINE_SCHEMA), *frames])
