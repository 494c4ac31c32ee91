"""Deliveries become one truth: each flight, pack and time once, whoever delivered it, in whatever order."""

import json
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import NamedTuple

import polars as pl

from pipelines.intake.columns import SI_NAMES, WORDS
from pipelines.intake.ledger import MAX_ROWS_LISTED, QUARANTINE_SCHEMA, Fault, first_and_rest, quarantine

FLIGHT = ("operator", "source", "flight_id")
KEY = (*FLIGHT, "pack", "time_utc")
VALUES = (*SI_NAMES, *WORDS)
SAME = 1e-6
"""Relative difference below which two values are one value: a 32-bit float and the text it was printed from."""


class MergeResult(NamedTuple):
    """One row a key; for each file and flight how many rows said nothing new; the rows that said something else."""

    rows: pl.DataFrame
    duplicates: pl.DataFrame
    quarantine: pl.DataFrame


def merge_deliveries(frames: Iterable[pl.DataFrame], received_at: Mapping[str, datetime]) -> MergeResult:
    """Store each flight, pack and time once.

    What one file holds of a flight is a delivery. Deliveries that contradict each other are never mixed: the one with
    most rows wins as a whole, then with most values, then the file named after its flight, then by name. Its rows are
    stored, and those of the other that say anything else are kept aside as `conflicting_delivery`. Deliveries that
    agree complete each other, and of their rows of one key the one with most values is stored. So what is stored
    depends on what was delivered, never on when; all deliveries of a flight must be merged together.

    Parameters
    ----------
    frames : iterable of DataFrame
        Rows of `read_snapshots`.
    received_at : mapping
        When each file was received, for the quarantine.

    Returns
    -------
    MergeResult
        `rows` sorted by flight, time and pack; `duplicates` with `file, flight_id, n_duplicate`; `quarantine`.
    """
    rows = pl.concat(list(frames))
    repeated = rows.select(pl.struct(KEY).is_duplicated()).to_series()
    contested = rows.filter(repeated).select(FLIGHT).unique()
    once, again = rows.join(contested, on=FLIGHT, how="anti"), rows.join(contested, on=FLIGHT, how="semi")
    won, lost = _settled(again)
    agreed, differing = _against(lost, won)
    duplicates = agreed.group_by("file", "flight_id").agg(pl.len().cast(pl.Int64).alias("n_duplicate"))
    return MergeResult(
        pl.concat([once, won]).sort("operator", "flight_id", "source", "time_utc", "pack"),
        duplicates.sort("file", "flight_id"),
        _conflicts(differing, received_at),
    )


def _settled(rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Rows to be stored, one a key, and all others with the `winner`, the first delivery of their flight."""
    own, repeated = _contest(rows, (*KEY, "file"))
    ranks = _ranked(own)
    ranked = own.join(ranks, on=(*FLIGHT, "file"), validate="m:1")
    accepted = ranked.filter(pl.col("rank") == 1)
    most = ranks.select(pl.col("rank").max()).item() or 1
    for rank in range(2, most + 1):
        late = ranked.filter(pl.col("rank") == rank)
        odd = contradictions(late, accepted).select(FLIGHT).unique()
        accepted = pl.concat([accepted, late.join(odd, on=FLIGHT, how="anti")])
    won, lost = _contest(accepted, KEY)
    aside = ranked.join(accepted.select(*FLIGHT, "file").unique(), on=(*FLIGHT, "file"), how="anti")
    others = [*(f.select(rows.columns) for f in (lost, aside)), repeated]
    winners = ranks.filter(pl.col("rank") == 1).select(*FLIGHT, winner="file")
    return won.select(rows.columns), pl.concat(others).join(winners, on=FLIGHT, how="left", validate="m:1")


def _contest(rows: pl.DataFrame, key: tuple[str, ...]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Of each key the row with most values, then the one whose values sort first; and those that lose."""
    order = (*key, "n_values", *VALUES, "file", "row_in_file")
    descending = [c == "n_values" for c in order]
    counted = rows.with_columns(_n_values().alias("n_values"))
    ranked = counted.sort(order, descending=descending, nulls_last=True).drop("n_values")
    first = ranked.select(pl.struct(key).is_first_distinct()).to_series()
    return ranked.filter(first), ranked.filter(~first)


def _n_values() -> pl.Expr:
    return pl.sum_horizontal(pl.col(c).is_not_null() for c in VALUES)


def _ranked(own: pl.DataFrame) -> pl.DataFrame:
    """Deliveries of each flight in the order in which they are believed: `rank` from 1."""
    named = pl.col("file").str.contains(pl.concat_str(pl.lit("/"), "flight_id", pl.lit(".")), literal=True)
    sizes = own.group_by(*FLIGHT, "file").agg(pl.len().alias("n"), _n_values().sum().alias("n_values"))
    order = (*FLIGHT, "n", "n_values", "named", "file")
    descending = [c in ("n", "n_values", "named") for c in order]
    ordered = sizes.with_columns(named.alias("named")).sort(order, descending=descending)
    return ordered.select(*FLIGHT, "file", pl.int_range(1, pl.len() + 1).over(FLIGHT).alias("rank"))


def contradictions(rows: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    """Rows of which `others` give another value for the same flight, pack and time."""
    pairs = rows.join(others.select(*KEY, *VALUES), on=KEY, suffix=" won", validate="m:m")
    return pairs.filter(pl.any_horizontal(~_agrees(c) & pl.col(f"{c} won").is_not_null() for c in VALUES))


def _against(lost: pl.DataFrame, won: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Losers that say no more than what is stored of their key, and those that do, with what `differs`."""
    here = won.select(*KEY, *VALUES, pl.lit(True).alias("met"), *(pl.col(c).alias(f"{c} won") for c in _PLACE))
    pairs = lost.join(here, on=KEY, how="left", suffix=" won", maintain_order="left", validate="m:1")
    differs = [pl.when(~_agrees(c)).then(pl.lit(c)) for c in VALUES]
    pairs = pairs.with_columns(pl.concat_list(differs).list.drop_nulls().list.join(", ").alias("differs"))
    agreed = (pl.col("differs") == "") & pl.col("met").fill_null(False)
    return pairs.filter(agreed), pairs.filter(~agreed)


_PLACE = ("file", "row_in_file")


def _agrees(column: str) -> pl.Expr:
    """Whether a loser's value is null or the winner's."""
    value, winner = pl.col(column), pl.col(f"{column} won")
    close = value == winner
    if column in SI_NAMES:
        close = (value - winner).abs() <= SAME * pl.max_horizontal(value.abs(), winner.abs())
    return value.is_null() | close.fill_null(False)


def _conflicts(differing: pl.DataFrame, received_at: Mapping[str, datetime]) -> pl.DataFrame:
    """Quarantine rows of what is kept aside, each as it came in SI."""
    faults: dict[str, list[Fault]] = {}
    listed, rest = first_and_rest(differing.sort(*_PLACE, "flight_id", "differs"), ["file"], MAX_ROWS_LISTED)
    for row in listed.iter_rows(named=True):
        detail = f"It conflicts with row {row['row_in_file won']} of {row['file won']}."
        if not row["met"]:
            detail = f"Its delivery conflicts with {row['winner']}, which does not hold this row."
        fault = Fault("conflicting_delivery", row["row_in_file"], row["differs"] if row["met"] else None, detail, 1,
                      row["flight_id"], as_content(row))  # fmt: skip
        faults.setdefault(row["file"], []).append(fault)
    for file, n in rest.iter_rows():
        faults[file].append(Fault("conflicting_delivery", detail=f"And {n} more rows.", n_rows=n))
    frames = [quarantine(file, received_at.get(file), found) for file, found in faults.items()]
    return pl.concat([pl.DataFrame(schema=QUARANTINE_SCHEMA), *frames])


def as_content(row: Mapping[str, object]) -> str:
    """A row in SI for the quarantine."""
    return as_text({c: row[c] for c in ("pack", "time_utc", *VALUES)})


def as_text(row: Mapping[str, object]) -> str:
    """What a row says, numbers to six digits, as JSON."""
    said = {c: float(f"{v:.6g}") if isinstance(v, float) else v for c, v in row.items() if v is not None}
    return json.dumps(said, default=str)
