"""Merge deliveries: each flight, pack and time once, whoever delivered it, in whatever order."""

import json
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

import polars as pl

from pipelines.intake.columns import SI_NAMES, WORDS
from pipelines.intake.copies import SAME, repeats
from pipelines.intake.faults import MAX_ROWS_LISTED, NO_FAULTS, Fault, quarantine
from pipelines.intake.silences import note_silences

FLIGHT = ("operator", "source", "flight_id")
KEY = (*FLIGHT, "pack", "time_utc")
VALUES = (*SI_NAMES, *WORDS)
ACCOUNT = ("file", "flight_id")
REPLACED_ROW = "replaced_row"
SAME_TIME = "same_time"
_PLACE = ("file", "row_in_file")


class MergeResult(NamedTuple):
    """One row a key; for each file and flight the number of duplicates; quarantine rows of the flights as merged."""

    rows: pl.DataFrame
    duplicates: pl.DataFrame
    quarantine: pl.DataFrame


def merge_deliveries(frames: Iterable[pl.DataFrame], received_at: Mapping[str, datetime]) -> MergeResult:
    """Store each flight, pack and time once.

    What one file holds of a flight is a delivery. Deliveries that contradict each other, by other values at one
    time or by the same readings at other times, are never mixed: the one with most rows wins as a whole, then with
    most values, then the file named after its flight, then by name. Its rows are stored, and those of the other
    that differ are quarantined as `conflicting_delivery`. Deliveries that agree complete each other, and of their
    rows of one key the one with most values is stored. So the stored rows depend on what was delivered, never on
    when; all deliveries of a flight must be merged together. Of a file's own rows of one key one is stored, and
    those that differ are quarantined as `same_time`.

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
    in_other_file = pl.col("file") != pl.col("file").first().over(FLIGHT)
    has_rival = rows.select(pl.struct(KEY).is_duplicated() | in_other_file).to_series()
    rival_flights = rows.filter(has_rival).select(FLIGHT).unique()
    single = rows.join(rival_flights, on=FLIGHT, how="anti")
    contested = rows.join(rival_flights, on=FLIGHT, how="semi")
    stored_rows, others = _choose(contested)
    duplicates_of_stored, differing = _compare(others, stored_rows)
    duplicates = duplicates_of_stored.group_by("file", "flight_id").agg(pl.len().cast(pl.Int64).alias("n_duplicate"))
    return MergeResult(
        pl.concat([single, stored_rows]).sort("operator", "flight_id", "source", "time_utc", "pack"),
        duplicates.sort("file", "flight_id"),
        pl.concat([_conflict_rows(differing, received_at), _note_silences_between_files(stored_rows, received_at)]),
    )


def _choose(rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Choose the rows to store, one a key; all others with the `winner`, the first delivery of their flight.

    `is_copy` is true where their delivery holds what is stored at other times.
    """
    own, same_key_in_file = _best_of_key(rows, (*KEY, "file"))
    ranks = _rank_deliveries(own)
    by_rank = own.join(ranks, on=(*FLIGHT, "file"), validate="m:1")
    consistent = by_rank.filter(pl.col("rank") == 1)
    copies = []
    lowest = ranks.select(pl.col("rank").max()).item() or 1
    for rank in range(2, lowest + 1):
        of_rank = by_rank.filter(pl.col("rank") == rank)
        contradicting = contradictions(of_rank, consistent).select(FLIGHT).unique()
        agreeing = of_rank.join(contradicting, on=FLIGHT, how="anti")
        copied = _copied_flights(agreeing, consistent)
        copies.append(agreeing.join(copied, on=FLIGHT, how="semi").select(*FLIGHT, "file").unique())
        consistent = pl.concat([consistent, agreeing.join(copied, on=FLIGHT, how="anti")])
    stored_rows, same_key = _best_of_key(consistent, KEY)
    of_rejected = by_rank.join(consistent.select(*FLIGHT, "file").unique(), on=(*FLIGHT, "file"), how="anti")
    others = [*(f.select(rows.columns) for f in (same_key, of_rejected)), same_key_in_file]
    winners = ranks.filter(pl.col("rank") == 1).select(*FLIGHT, winner="file")
    is_copy = pl.concat([ranks.clear().select(*FLIGHT, "file"), *copies]).with_columns(is_copy=pl.lit(True))
    with_winners = pl.concat(others).join(winners, on=FLIGHT, how="left", validate="m:1")
    with_copies = with_winners.join(is_copy, on=(*FLIGHT, "file"), how="left", validate="m:1")
    return stored_rows.select(rows.columns), with_copies.with_columns(pl.col("is_copy").fill_null(False))


def _copied_flights(rows: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    """Find the flights of which `rows`, one delivery each, are the `others` at other times.

    Reports only: a flight's log comes under one name.
    """
    reports = rows.filter(pl.col("source") == "acms").join(others, on=KEY, how="anti")
    of_flights = others.join(reports, on=FLIGHT, how="semi").partition_by(FLIGHT, as_dict=True)
    flights = reports.partition_by(FLIGHT, as_dict=True)
    copied = [flight for flight, own in flights.items() if repeats(own, of_flights[flight])]
    return pl.DataFrame(copied, schema=rows.select(FLIGHT).schema, orient="row")


def _best_of_key(rows: pl.DataFrame, key: tuple[str, ...]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Choose for each key the row with most values, then the one whose values sort first; and the others."""
    order = (*key, "n_values", *VALUES, "file", "row_in_file")
    descending = [c == "n_values" for c in order]
    with_counts = rows.with_columns(_n_values().alias("n_values"))
    in_order = with_counts.sort(order, descending=descending, nulls_last=True).drop("n_values")
    first = in_order.select(pl.struct(key).is_first_distinct()).to_series()
    return in_order.filter(first), in_order.filter(~first)


def _n_values() -> pl.Expr:
    return pl.sum_horizontal(pl.col(c).is_not_null() for c in VALUES)


def _rank_deliveries(own: pl.DataFrame) -> pl.DataFrame:
    """Rank the deliveries of each flight by precedence: `rank` from 1."""
    named_after_flight = pl.col("file").str.contains(pl.concat_str(pl.lit("/"), "flight_id", pl.lit(".")), literal=True)
    sizes = own.group_by(*FLIGHT, "file").agg(pl.len().alias("n"), _n_values().sum().alias("n_values"))
    order = (*FLIGHT, "n", "n_values", "named", "file")
    descending = [c in ("n", "n_values", "named") for c in order]
    in_order = sizes.with_columns(named_after_flight.alias("named")).sort(order, descending=descending)
    return in_order.select(*FLIGHT, "file", pl.int_range(1, pl.len() + 1).over(FLIGHT).alias("rank"))


def contradictions(rows: pl.DataFrame, others: pl.DataFrame) -> pl.DataFrame:
    """Select rows of which `others` give another value for the same flight, pack and time."""
    pairs = rows.join(others.select(*KEY, *VALUES), on=KEY, suffix=" stored", validate="m:m")
    return pairs.filter(pl.any_horizontal(~_agrees(c) & pl.col(f"{c} stored").is_not_null() for c in VALUES))


def _compare(others: pl.DataFrame, stored_rows: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Split rows into those that agree with the stored row of their key and the others, with what `differs`."""
    stored_columns = stored_rows.select(
        *KEY, *VALUES, pl.lit(True).alias("is_stored"), *(pl.col(c).alias(f"{c} stored") for c in _PLACE)
    )
    pairs = others.join(stored_columns, on=KEY, how="left", suffix=" stored", maintain_order="left", validate="m:1")
    differs = [pl.when(~_agrees(c)).then(pl.lit(c)) for c in VALUES]
    pairs = pairs.with_columns(pl.concat_list(differs).list.drop_nulls().list.join(", ").alias("differs"))
    agrees = (pl.col("differs") == "") & pl.col("is_stored").fill_null(False)
    return pairs.filter(agrees), pairs.filter(~agrees)


def _agrees(column: str) -> pl.Expr:
    """Return whether a row's value is null or the stored one."""
    value = pl.col(column)
    winner = pl.col(f"{column} stored")
    close = value == winner
    if column in SI_NAMES:
        close = (value - winner).abs() <= SAME * pl.max_horizontal(value.abs(), winner.abs())
    return value.is_null() | close.fill_null(False)


def _conflict_rows(differing: pl.DataFrame, received_at: Mapping[str, datetime]) -> pl.DataFrame:
    """Make quarantine rows of conflicting rows, with their content in SI."""
    faults = []
    same_file = pl.col("is_stored").fill_null(False) & (pl.col("file") == pl.col("file stored")).fill_null(False)
    reason = pl.when(same_file).then(pl.lit(SAME_TIME)).otherwise(pl.lit("conflicting_delivery"))
    with_reasons = differing.with_columns(reason.alias("reason")).sort(*_PLACE, "flight_id", "differs")
    is_listed = pl.int_range(pl.len()).over("file", "reason") < MAX_ROWS_LISTED
    for row in with_reasons.filter(is_listed).iter_rows(named=True):
        detail = f"It conflicts with row {row['row_in_file stored']} of {row['file stored']}."
        if not row["is_stored"]:
            detail = f"Its delivery conflicts with {row['winner']}, which does not hold this row."
        if row["is_copy"]:
            detail = f"Its delivery repeats {row['winner']} at other times."
        columns = row["differs"] if row["is_stored"] else None
        fault = row["reason"], row["row_in_file"], columns, detail, 1, row["flight_id"], _content(row)
        faults.append((row["file"], Fault(*fault)))
    # by flight, for the account of each flight must balance
    more = (
        with_reasons.filter(~is_listed).group_by(*ACCOUNT, "reason", maintain_order=True).agg(pl.len().cast(pl.Int64))
    )
    for file, flight_id, reason, n in more.iter_rows():
        faults.append((file, Fault(reason, detail=f"And {n} more rows.", n_rows=n, flight_id=flight_id)))
    return _quarantine(faults, received_at)


def _note_silences_between_files(stored_rows: pl.DataFrame, received_at: Mapping[str, datetime]) -> pl.DataFrame:
    """Note flights of several files that lie hours apart; the file of the last report has the note."""
    of_files = stored_rows.filter(pl.col("file").n_unique().over(FLIGHT) > 1)
    last_file = pl.col("file").sort_by("time_utc", "pack").last().over(FLIGHT)
    notes = note_silences(of_files.with_columns(last_file), ACCOUNT)
    return _quarantine(notes, received_at)


def _quarantine(faults: Iterable[tuple[str, Fault]], received_at: Mapping[str, datetime]) -> pl.DataFrame:
    """Turn faults, each with its file, into quarantine rows."""
    by_file: dict[str, list[Fault]] = {}
    for file, fault in faults:
        by_file.setdefault(file, []).append(fault)
    frames = [quarantine(file, received_at.get(file), own) for file, own in by_file.items()]
    return pl.concat([NO_FAULTS, *frames])


def _content(row: Mapping[str, object]) -> str:
    return json_text({c: row[c] for c in ("pack", "time_utc", *VALUES)})


def json_text(row: Mapping[str, object]) -> str:
    """Format a row as JSON, numbers to six digits."""
    values = {c: float(f"{v:.6g}") if isinstance(v, float) else v for c, v in row.items() if v is not None}
    return json.dumps(values, default=str)


def compare_redelivery(
    rows: pl.DataFrame,
    quarantine_rows: pl.DataFrame,
    stored_rows: pl.DataFrame,
    stored_quarantine: pl.DataFrame,
    received_at: Mapping[str, datetime],
) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Compare some flights in files with what is stored of an earlier version of these files.

    Parameters
    ----------
    rows, quarantine_rows : DataFrame
        Good rows in the files now, and quarantine rows.
    stored_rows, stored_quarantine : DataFrame
        Rows and quarantine rows stored under the names of these files.
    received_at : mapping
        When each file was received.

    Returns
    -------
    rows, quarantine : DataFrame
        Stored rows that the files lack, and new quarantine rows. Only a file counts that has some rows of a flight and
        fewer than are stored of it; one with none leaves the flight unchanged, any other replaces it. One that was cut
        repeats stored rows and no others: what it lacks stays. One with other values or times replaces the flight as a
        whole, and what it lacks is quarantined. A note gives both counts.
    """
    replaced_rows = stored_quarantine.filter(pl.col("reason") == REPLACED_ROW)
    before = count_rows(stored_rows, replaced_rows)
    now = count_rows(rows, quarantine_rows)
    fewer = before.join(now, on=ACCOUNT, suffix="_now", validate="m:1").filter(pl.col("n_now") < pl.col("n"))
    if fewer.is_empty():
        return rows.clear(), NO_FAULTS
    fewer_but_some = fewer.join(rows.select(ACCOUNT).unique(), on=ACCOUNT, how="semi")
    old = stored_rows.join(fewer_but_some, on=ACCOUNT, how="semi")
    missing_rows = old.join(rows, on=(*KEY, "file"), how="anti")
    conflicts = _conflicting(old, rows)
    new_rows = [
        _notes(fewer.join(conflicts, on=ACCOUNT, how="anti"), "kept", received_at),
        _notes(fewer.join(conflicts, on=ACCOUNT, how="semi"), "set aside", received_at),
        _replaced_rows(missing_rows.join(conflicts, on=ACCOUNT, how="semi"), received_at),
        replaced_rows.join(fewer, on=ACCOUNT, how="semi").select(NO_FAULTS.columns),
    ]
    return missing_rows.join(conflicts, on=ACCOUNT, how="anti").select(rows.columns), pl.concat(new_rows)


def count_rows(rows: pl.DataFrame | None, quarantine: pl.DataFrame | None, by: Sequence[str] = ACCOUNT) -> pl.DataFrame:
    """Count rows and the delivered rows behind quarantine rows, for each file and flight: `n`."""
    counts = [] if rows is None else [rows.select(*by, n=pl.lit(1, pl.Int64))]
    counts += [] if quarantine is None else [quarantine.select(*by, n="n_rows")]
    return pl.concat(counts).group_by(by).agg(pl.col("n").sum())


def _conflicting(old: pl.DataFrame, rows: pl.DataFrame) -> pl.DataFrame:
    """Find files and flights of which the new version gives other values or times than the old."""
    files = old["file"].unique().to_list()
    pairs = [contradictions(old.filter(file=f), rows.filter(file=f)).select(ACCOUNT) for f in files]
    same_flights = rows.join(old.select(ACCOUNT).unique(), on=ACCOUNT, how="semi")
    other_times = same_flights.join(old, on=(*KEY, "file"), how="anti").select(ACCOUNT)
    return pl.concat([other_times, *pairs]).unique()


def _notes(fewer: pl.DataFrame, outcome: str, received_at: Mapping[str, datetime]) -> pl.DataFrame:
    detail = f"It had {{}} rows of this flight and now has {{}}. What it lacks is {outcome}."
    counts = fewer.sort(ACCOUNT).iter_rows()
    faults = ((f, Fault("fewer_rows", detail=detail.format(n, now), flight_id=flight)) for f, flight, n, now in counts)
    return _quarantine(faults, received_at)


def _replaced_rows(rows: pl.DataFrame, received_at: Mapping[str, datetime]) -> pl.DataFrame:
    in_order = rows.sort(*ACCOUNT, "time_utc", "pack").iter_rows(named=True)
    faults = ((r["file"], Fault(REPLACED_ROW, None, None, "", 1, r["flight_id"], _content(r))) for r in in_order)
    return _quarantine(faults, received_at)
