"""Rows of recorder files are judged: which may be stored, which are kept aside and why, which values are none."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta

import polars as pl

from pipelines.intake.columns import AIRPORTS, PHASE, SIGNAL_COLUMNS, SIGNAL_NAMES, WORDS
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.laws import over_atmosphere
from pipelines.intake.ledger import MAX_ROWS_LISTED, Fault, first_and_rest
from pipelines.intake.names import EARLIEST, flight_day, flight_of_file, flight_tail, is_history
from pipelines.intake.wiring import OUTSIDE, miswritten_rows

EARLY, LATE = timedelta(hours=3), timedelta(hours=48)
"""A flight's reports lie between 3 h before its UTC day begins (doors close before midnight) and 48 h after that."""
AIRPORT = r"^[A-Z]{4}$"
PHASES = ("TO", "CL", "CR", "DS", "AP", "GR")
SILENCE = timedelta(hours=3)
"""Reports come every 2 to 10 minutes; the longest silence of a sound flight in the sample fleet is 26 minutes."""
NO_FLIGHT = ("repeated_header", "bad_flight_id", "flight_id_contradicts_path")
"""Reasons that leave a row without a flight it could belong to."""

_COLUMN_OF = {
    "repeated_header": "", "bad_pack": "pack",
    **dict.fromkeys(("bad_flight_id", "flight_id_contradicts_path", "too_early"), "flight_id"),
    **dict.fromkeys(("unreadable_time", "future_time", "time_contradicts_flight_id"), "report_time"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ValidatedRows:
    """Rows that may be stored, in recorded units with broken values nulled, and faults with the file they are of."""

    rows: pl.DataFrame
    faults: list[tuple[int, Fault]]


def about_files(files: Sequence[LandingFile]) -> pl.DataFrame:
    """What path and fleet list say of each file: operator, tail, source, the flight it is named after, packs."""
    rows = []
    for f in files:
        named = flight_of_file(f.name, f.tail)
        odd = named is None and not is_history(f.name)
        rows.append((f.path, f.operator, f.tail, f.source, f.is_text, named, odd, _unlisted(f), f.packs, _fewer(f)))
    schema = {"file": pl.String, "operator": pl.String, "tail": pl.String, "source": pl.String, "is_text": pl.Boolean,
              "named": pl.String, "odd_name": pl.Boolean, "unknown": pl.String, "packs": pl.Int64,
              "fewer": pl.String}  # fmt: skip
    return pl.DataFrame(rows, schema=schema, orient="row")


def _unlisted(file: LandingFile) -> str:
    """Of an aircraft that is not on the list its name, and operators under which its tail is; else empty."""
    if file.unlisted is None:
        return ""
    others = ", ".join(file.unlisted.split(","))
    return f"{file.operator} {file.tail}" + (f"; the list has this tail under {others}." if others else ".")


def _fewer(file: LandingFile) -> str:
    """How many packs the list gives where more are stored of the file; else empty."""
    return f"{file.packs_listed} for {file.packs_stored}." if file.packs_listed < file.packs_stored else ""


def judge(raw: pl.DataFrame, about: pl.DataFrame, now: datetime) -> ValidatedRows:
    """Judge rows of several files.

    Parameters
    ----------
    raw : DataFrame
        `file_index, row, flight_id, report_time` (UTC), `pack`, phase code and all signals in recorded units.
    about : DataFrame
        From `about_files`, one row a file.
    now : datetime
        Times after it lie in the future.
    """
    sane = pl.col(SIGNAL_NAMES)
    slips = miswritten_rows(raw.with_columns(pl.when(sane.is_finite()).then(sane)))
    verdict = _verdicts(raw, about, now, slips.filter(pl.col("reason") != OUTSIDE))
    bad = verdict.get_column("reason").is_not_null()
    faults = _row_faults(raw, verdict, bad, about) if bad.any() else []
    read_as = _read_as(raw, slips.filter(reason=OUTSIDE))
    stored = raw.filter(~bad) if bad.any() else raw
    rows, values = _null_broken(stored, read_as)
    return ValidatedRows(rows, [*faults, *values, *_notes(rows, about)])


def _read_as(raw: pl.DataFrame, slips: pl.DataFrame) -> dict[tuple[int, str, str], str]:
    """Of files, flights and columns whose values lie outside all sense the unit that they fit, as a sentence."""
    some = raw.select("file_index", "flight_id").with_row_index().join(slips, on="index", validate="1:1")
    keys = some.select("file_index", "flight_id", "column_name", "told").unique().rows()
    return {(file, flight, column): told for file, flight, column, told in keys}


def _verdicts(raw: pl.DataFrame, about: pl.DataFrame, now: datetime, slips: pl.DataFrame) -> pl.DataFrame:
    """Reason each row is refused for, null where it is not, and the columns at fault."""
    unit = ("file_index", "flight_id")
    flights = _flights(raw.select(unit).unique(), about)
    keys = raw.select(*unit, "report_time", "pack").join(
        flights, on=unit, how="left", nulls_equal=True, maintain_order="left", validate="m:1"
    )
    moment, pack = pl.col("report_time"), pl.col("pack")
    in_flight = moment.is_between(pl.col("day") - EARLY, pl.col("day") + LATE)
    reason = (
        pl.when(pl.col("wrong_id").is_not_null()).then("wrong_id")
        .when(moment.is_null()).then(pl.lit("unreadable_time"))
        .when(moment > pl.lit(now).dt.cast_time_unit("us")).then(pl.lit("future_time"))
        .when(~in_flight).then(pl.lit("time_contradicts_flight_id"))
        .when(~(pack.is_between(1, pl.col("packs")) & (pack == pack.floor())).fill_null(False)).then(pl.lit("bad_pack"))
    )  # fmt: skip
    verdict = keys.select(reason.alias("reason"))
    if slips.is_empty():
        return verdict.with_columns(pl.lit(None, pl.String).alias(c) for c in ("slipped", "told"))
    slips = slips.rename({"reason": "slip", "column_name": "slipped"})
    joined = verdict.with_row_index("index").join(slips, on="index", how="left", maintain_order="left", validate="m:1")
    return joined.select(
        pl.coalesce("reason", "slip").alias("reason"),
        pl.when(pl.col("reason").is_null()).then("slipped"),
        pl.when(pl.col("reason").is_null()).then("told"),
    )


def _flights(pairs: pl.DataFrame, about: pl.DataFrame) -> pl.DataFrame:
    """For each file and flight_id: why the id is wrong (null if it is not), its UTC day, packs of the aircraft."""
    tails, named, packs = (about.get_column(c).to_list() for c in ("tail", "named", "packs"))
    rows = []
    for i, flight in pairs.iter_rows():
        day = flight_day(flight) if flight else None
        wrong = None
        if day is None:
            wrong = "repeated_header" if flight == "flight_id" else "bad_flight_id"
        elif flight_tail(flight) != tails[i] or named[i] not in (None, flight):
            wrong = "flight_id_contradicts_path"
        elif day < EARLIEST:
            wrong = "too_early"
        rows.append((i, flight, wrong, day and datetime.combine(day, time(), UTC), packs[i]))
    added = {"wrong_id": pl.String(), "day": pl.Datetime("us", "UTC"), "packs": pl.Int64()}
    schema = pl.Schema({**pairs.schema, **added})
    return pl.DataFrame(rows, schema=schema, orient="row")


def _row_faults(
    raw: pl.DataFrame, verdict: pl.DataFrame, bad: pl.Series, about: pl.DataFrame
) -> list[tuple[int, Fault]]:
    is_text = about.get_column("is_text").to_list()  # then the caller shows the line as it came
    refused = raw.filter(bad).hstack(verdict.filter(bad).select(pl.all().name.prefix("_")))
    refused, rest = first_and_rest(refused, ["file_index", "_reason"], MAX_ROWS_LISTED)
    faults = []
    for row in refused.iter_rows(named=True):
        i, reason, slipped, told = row["file_index"], row.pop("_reason"), row.pop("_slipped"), row.pop("_told")
        column = _COLUMN_OF.get(reason, slipped) or None
        found = row.get(column) if column else None
        detail = told or (f"Found {str(found)[:60]!r}." if found is not None else "")
        flight = None if reason in NO_FLIGHT else row["flight_id"]
        content = None if is_text[i] else _as_text(row)
        faults.append((i, Fault(reason, row["row"], column, detail, 1, flight, content)))
    more = [(i, Fault(reason, detail=f"And {n} more rows.", n_rows=n)) for i, reason, n in rest.iter_rows()]
    return faults + more


def _as_text(row: dict[str, object]) -> str:
    return json.dumps({k: v for k, v in row.items() if k not in ("file_index", "row") and v is not None}, default=str)


def _null_broken(
    rows: pl.DataFrame, read_as: Mapping[tuple[int, str, str], str]
) -> tuple[pl.DataFrame, list[tuple[int, Fault]]]:
    """Rows without values that are no number or physically impossible, and a fault for each of those."""
    broken = {c.name: ~(pl.col(c.name).is_between(c.low, c.high) & pl.col(c.name).is_finite()) for c in SIGNAL_COLUMNS}
    broken[PHASE] = ~pl.col(PHASE).is_in(PHASES) & (pl.col(PHASE) != "")
    broken |= {c: ~pl.col(c).str.contains(AIRPORT) & (pl.col(c) != "") for c in AIRPORTS}
    any_broken = rows.select(e.any().alias(c) for c, e in broken.items()).row(0, named=True) if rows.height else {}
    faults: list[tuple[int, Fault]] = []
    for name in (c for c, found in any_broken.items() if found):
        found = rows.filter(broken[name]).select("file_index", "row", "flight_id", name)
        found, rest = first_and_rest(found, ["file_index"], MAX_ROWS_LISTED)
        faults += [
            (i, _value_fault(name, row, flight, value, read_as.get((i, flight, name), "")))
            for i, row, flight, value in found.iter_rows()
        ]
        faults += [(i, Fault("out_of_range", None, name, f"And {n} more values.")) for i, n in rest.iter_rows()]
    nulled = [pl.when(~broken[c].fill_null(False)).then(c).alias(c) for c, found in any_broken.items() if found]
    return rows.with_columns(nulled).with_columns(pl.when(pl.col(c) != "").then(c).alias(c) for c in WORDS), faults


def _value_fault(name: str, row: int, flight: str, value: float | str, fits: str) -> Fault:
    if isinstance(value, str):
        reason = "unknown_phase" if name == PHASE else "unknown_airport"
        return Fault(reason, row, name, f"Found {value[:40]!r}.", flight_id=flight)
    reason = "out_of_range" if abs(value) < float("inf") else "not_a_number"
    return Fault(reason, row, name, f"Found {value:g}. {fits}".rstrip(), flight_id=flight)


def _notes(rows: pl.DataFrame, about: pl.DataFrame) -> list[tuple[int, Fault]]:
    """Notes on files that rows were stored from."""
    notes = []
    for i in rows.get_column("file_index").unique().sort().to_list():
        if about.item(i, "unknown"):
            notes.append((i, Fault("unknown_tail", detail=about.item(i, "unknown"))))
        if about.item(i, "fewer"):
            notes.append((i, Fault("fewer_packs", None, "pack", about.item(i, "fewer"))))
        if about.item(i, "odd_name"):
            notes.append((i, Fault("flight_id_from_column")))
    return notes + _clock_jumps(rows) + _implausible_pressure(rows)


def _implausible_pressure(rows: pl.DataFrame) -> list[tuple[int, Fault]]:
    """A note for each flight whose pressure, altitude and Mach cannot all be in the agreed units."""
    names = ("altitude_ft", "mach", "pt_psia")
    whole = rows.select("file_index", "flight_id", *names).drop_nulls(names)
    si = {c.si_name: whole[c.name].to_numpy() * c.scale + c.offset for c in SIGNAL_COLUMNS if c.name in names}
    whole = whole.with_columns(ratio=over_atmosphere(si))
    flights = whole.group_by("file_index", "flight_id").agg(pl.col("ratio").median(), n=pl.len())
    odd = flights.filter(pl.col("n") >= 3, ~pl.col("ratio").is_between(0.8, 1.25)).sort("file_index", "flight_id")
    column = "pt_psia, altitude_ft, mach"
    return [
        (i, Fault("implausible_pressure", None, column, f"It is {ratio:.2g} times that.", flight_id=flight))
        for i, flight, ratio in odd.drop("n").iter_rows()
    ]


def _clock_jumps(rows: pl.DataFrame) -> list[tuple[int, Fault]]:
    """A note for each flight whose reports, put in order, lie hours apart: the clock was set on the way."""
    longest = pl.col("report_time").sort().diff().max().alias("silence")
    flights = rows.group_by("file_index", "flight_id").agg(longest).filter(pl.col("silence") > SILENCE)
    return [
        (i, Fault("clock_jump", None, "report_time", f"Longest silence: {silence}.", flight_id=flight))
        for i, flight, silence in flights.sort("file_index", "flight_id").iter_rows()
    ]
