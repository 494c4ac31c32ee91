"""Validate rows of recorder files: rows to store, rejected rows with their reasons, invalid values."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta

import polars as pl

from pipelines.intake.columns import AIRPORTS, PHASE, SIGNAL_COLUMNS, SIGNAL_NAMES, WORDS, pressure_over_atmosphere
from pipelines.intake.faults import MAX_ROWS_LISTED, Fault, first_and_rest
from pipelines.intake.landing_file import EARLIEST, LandingFile, flight_day, flight_tail, is_history
from pipelines.intake.silences import note_silences
from pipelines.intake.unit_slips import OUTSIDE, find_unit_slips

EARLY, LATE = timedelta(hours=3), timedelta(hours=48)
"""Limits of a flight's times: 3 h before its UTC day begins (doors close before midnight) and 48 h after that."""
AIRPORT = r"^[A-Z]{4}$"
PHASES = ("TO", "CL", "CR", "DS", "AP", "GR")
IN_THE_AIR = ("altitude_ft", "mach")
LEAST_SHARE_0 = 0.2
"""Share of a flight's rows of a pack 0 from which on its packs count from 0."""
FROM_0 = "Packs count from 0 in this flight, so that a pack 1 may be the second."
NO_FLIGHT = ("repeated_header", "bad_flight_id", "flight_id_contradicts_path")
"""Reasons that leave a row without a flight."""

_COLUMN_OF = {
    "repeated_header": "", "bad_pack": "pack",
    **dict.fromkeys(("bad_flight_id", "flight_id_contradicts_path", "too_early"), "flight_id"),
    **dict.fromkeys(("unreadable_time", "time_contradicts_flight_id"), "report_time"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ValidatedRows:
    """Rows to store, in recorded units with invalid values nulled, and faults with the index of their file."""

    rows: pl.DataFrame
    faults: list[tuple[int, Fault]]


def validate_rows(raw: pl.DataFrame, files: Sequence[LandingFile]) -> ValidatedRows:
    """Validate rows of several files.

    Parameters
    ----------
    raw : DataFrame
        `file_index, row, flight_id, report_time` (UTC), `pack`, phase code and all signals in recorded units.
    files : sequence of LandingFile
        By `file_index`.
    """
    signals = pl.col(SIGNAL_NAMES)
    slips = find_unit_slips(raw.with_columns(pl.when(signals.is_finite()).then(signals)))
    reasons = _row_reasons(raw, files, slips.filter(pl.col("reason") != OUTSIDE))
    bad = reasons.get_column("reason").is_not_null()
    faults = _row_faults(raw, reasons, bad, files) if bad.any() else []
    rows, values = _null_invalid(raw.filter(~bad) if bad.any() else raw, _fitting_units(raw, slips))
    return ValidatedRows(rows, [*faults, *values, *_notes(rows, files)])


def _fitting_units(raw: pl.DataFrame, slips: pl.DataFrame) -> dict[tuple[int, str, str], str]:
    """Map file, flight and column of impossible values to a sentence on the unit that they fit."""
    outside = slips.filter(reason=OUTSIDE)
    rows = raw.select("file_index", "flight_id").with_row_index().join(outside, on="index", validate="1:1")
    keys = rows.select("file_index", "flight_id", "column_name", "sentence").unique().rows()
    return {(file, flight, column): sentence for file, flight, column, sentence in keys}


def _row_reasons(raw: pl.DataFrame, files: Sequence[LandingFile], slips: pl.DataFrame) -> pl.DataFrame:
    """Give the reason why each row is rejected, null where it is not, and the columns at fault."""
    unit = ("file_index", "flight_id")
    flights = _flights(raw.select(unit).unique(), files)
    keys = raw.select(*unit, "report_time", "pack").join(
        flights, on=unit, how="left", nulls_equal=True, maintain_order="left", validate="m:1"
    )
    keys = keys.with_columns(counts_from_0=counts_from_0(pl.col("packs")).over(unit))
    moment = pl.col("report_time")
    in_flight = moment.is_between(pl.col("day") - EARLY, pl.col("day") + LATE)
    reason = (
        pl.when(pl.col("wrong_id").is_not_null()).then("wrong_id")
        .when(moment.is_null()).then(pl.lit("unreadable_time"))
        .when(~in_flight).then(pl.lit("time_contradicts_flight_id"))
        .when(~is_pack(pl.col("packs")) | pl.col("counts_from_0")).then(pl.lit("bad_pack"))
    )  # fmt: skip
    reasons = keys.select(reason.alias("reason"), "counts_from_0")
    is_rejected = pl.col("reason").is_not_null()
    from_0 = pl.when((pl.col("reason") == "bad_pack") & pl.col("counts_from_0")).then(pl.lit(FROM_0))
    if slips.is_empty():
        return reasons.select("reason", column_name=pl.lit(None, pl.String), sentence=from_0)
    rows = reasons.with_row_index("index")
    rows = rows.join(slips, on="index", how="left", suffix="_slip", maintain_order="left", validate="m:1")
    return rows.select(
        reason=pl.coalesce("reason", "reason_slip"),
        column_name=pl.when(~is_rejected).then("column_name"),
        sentence=pl.coalesce(from_0, pl.when(~is_rejected).then("sentence")),
    )


def counts_from_0(packs: pl.Expr) -> pl.Expr:
    """Return whether a flight's rows number its `packs` from 0: each then has another's number, and none is sure."""
    pack = pl.col("pack")
    return ((pack == 0).mean() >= LEAST_SHARE_0) & ~(pack >= packs).any()


def in_future(now: datetime) -> pl.Expr:
    """Return whether a row's time is after `now`."""
    return pl.col("report_time") > pl.lit(now).dt.cast_time_unit("us")


def is_pack(packs: pl.Expr) -> pl.Expr:
    """Return whether a row's pack is the number of one of `packs`."""
    pack = pl.col("pack")
    return (pack.is_between(1, packs) & (pack == pack.floor())).fill_null(False)


def _flights(pairs: pl.DataFrame, files: Sequence[LandingFile]) -> pl.DataFrame:
    """Give for each file and flight_id the fault of the id (or null), its UTC day, and the aircraft's packs."""
    rows = []
    for i, flight in pairs.iter_rows():
        day = flight_day(flight) if flight else None
        wrong = None
        if day is None:
            wrong = "repeated_header" if flight == "flight_id" else "bad_flight_id"
        elif flight_tail(flight) != files[i].tail or files[i].flight not in (None, flight):
            wrong = "flight_id_contradicts_path"
        elif day < EARLIEST:
            wrong = "too_early"
        rows.append((i, flight, wrong, day and datetime.combine(day, time(), UTC), files[i].packs))
    types = {"wrong_id": pl.String(), "day": pl.Datetime("us", "UTC"), "packs": pl.Int64()}
    return pl.DataFrame(rows, schema=pl.Schema({**pairs.schema, **types}), orient="row")


def _row_faults(
    raw: pl.DataFrame, reasons: pl.DataFrame, bad: pl.Series, files: Sequence[LandingFile]
) -> list[tuple[int, Fault]]:
    bad_rows = raw.filter(bad).hstack(reasons.filter(bad).select(pl.all().name.prefix("_")))
    bad_rows, rest = first_and_rest(bad_rows, ["file_index", "_reason"], MAX_ROWS_LISTED)
    faults = []
    for row in bad_rows.iter_rows(named=True):
        i = row["file_index"]
        reason = row.pop("_reason")
        slip_columns = row.pop("_column_name")
        sentence = row.pop("_sentence")
        column = _COLUMN_OF.get(reason, slip_columns) or None
        value = row.get(column) if column else None
        value = f"{value:g}" if isinstance(value, float) else value
        detail = sentence or (f"Found {str(value)[:60]!r}." if value is not None else "")
        flight = None if reason in NO_FLIGHT else row["flight_id"]
        content = None if files[i].is_text else _as_text(row)  # of text the caller adds the delivered line
        faults.append((i, Fault(reason, row["row"], column, detail, 1, flight, content)))
    more = [(i, Fault(reason, detail=f"And {n} more rows.", n_rows=n)) for i, reason, n in rest.iter_rows()]
    return faults + more


def _as_text(row: dict[str, object]) -> str:
    return json.dumps({k: v for k, v in row.items() if k not in ("file_index", "row") and v is not None}, default=str)


def _null_invalid(
    rows: pl.DataFrame, fitting_units: Mapping[tuple[int, str, str], str]
) -> tuple[pl.DataFrame, list[tuple[int, Fault]]]:
    """Null values that are no number or physically impossible, with a fault for each."""
    invalid = {c.name: ~(pl.col(c.name).is_between(c.low, c.high) & pl.col(c.name).is_finite()) for c in SIGNAL_COLUMNS}
    invalid[PHASE] = ~pl.col(PHASE).is_in(PHASES) & (pl.col(PHASE) != "")
    invalid |= {c: ~pl.col(c).str.contains(AIRPORT) & (pl.col(c) != "") for c in AIRPORTS}
    any_invalid = rows.select(e.any().alias(c) for c, e in invalid.items()).row(0, named=True) if rows.height else {}
    names = [name for name, is_any in any_invalid.items() if is_any]
    faults: list[tuple[int, Fault]] = []
    for name in names:
        values = rows.filter(invalid[name]).select("file_index", "row", "flight_id", name)
        values, rest = first_and_rest(values, ["file_index"], MAX_ROWS_LISTED)
        faults += [
            (i, _value_fault(name, row, flight, value, fitting_units.get((i, flight, name), "")))
            for i, row, flight, value in values.iter_rows()
        ]
        faults += [(i, Fault("out_of_range", None, name, f"And {n} more values.")) for i, n in rest.iter_rows()]
    rows = rows.with_columns(pl.when(~invalid[name].fill_null(False)).then(name).alias(name) for name in names)
    return rows.with_columns(pl.when(pl.col(c) != "").then(c).alias(c) for c in WORDS), faults


def _value_fault(name: str, row: int, flight: str, value: float | str, fits: str) -> Fault:
    if isinstance(value, str):
        reason = "unknown_phase" if name == PHASE else "unknown_airport"
        return Fault(reason, row, name, f"Found {value[:40]!r}.", flight_id=flight)
    reason = "out_of_range" if abs(value) < float("inf") else "not_a_number"
    return Fault(reason, row, name, f"Found {value:g}. {fits}".rstrip(), flight_id=flight)


def _notes(rows: pl.DataFrame, files: Sequence[LandingFile]) -> list[tuple[int, Fault]]:
    """Make notes on files with stored rows."""
    notes = []
    for i in rows.get_column("file_index").unique().sort().to_list():
        file = files[i]
        if file.other_operators is not None:
            others = ", ".join(file.other_operators.split(","))
            more = f"; the list has this tail under {others}." if others else "."
            notes.append((i, Fault("unknown_tail", detail=f"{file.operator} {file.tail}{more}")))
        if file.packs_listed < file.packs_stored:
            detail = f"{file.packs_listed} for {file.packs_stored}."
            notes.append((i, Fault("fewer_packs", None, "pack", detail)))
        if file.flight is None and not is_history(file.name):
            notes.append((i, Fault("flight_id_from_column")))
    silences = note_silences(_in_si(rows).rename({"report_time": "time_utc"}), ("file_index", "flight_id"))
    return notes + silences + _implausible_pressure(rows)


def _implausible_pressure(rows: pl.DataFrame) -> list[tuple[int, Fault]]:
    """Make a note for each flight whose pressure, altitude and Mach cannot all be in the agreed units."""
    names = ("altitude_ft", "mach", "pt_psia")
    whole = rows.select("file_index", "flight_id", *names).drop_nulls(names)
    si = {c.si_name: whole[c.name].to_numpy() * c.scale + c.offset for c in SIGNAL_COLUMNS if c.name in names}
    whole = whole.with_columns(ratio=pressure_over_atmosphere(si))
    flights = whole.group_by("file_index", "flight_id").agg(pl.col("ratio").median(), n=pl.len())
    odd = flights.filter(pl.col("n") >= 3, ~pl.col("ratio").is_between(0.8, 1.25)).sort("file_index", "flight_id")
    column = "pt_psia, altitude_ft, mach"
    return [
        (i, Fault("implausible_pressure", None, column, f"It is {ratio:.2g} times that.", flight_id=flight))
        for i, flight, ratio in odd.drop("n").iter_rows()
    ]


def _in_si(rows: pl.DataFrame) -> pl.DataFrame:
    """Return what shows whether a flight is in the air, in SI."""
    signals = [(pl.col(c.name) * c.scale + c.offset).alias(c.si_name) for c in SIGNAL_COLUMNS if c.name in IN_THE_AIR]
    return rows.select("file_index", "flight_id", "report_time", *signals)
