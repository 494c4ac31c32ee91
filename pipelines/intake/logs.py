"""The logs beside the recorder files: messages, maintenance, and the fleet list."""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta

import polars as pl

from hdt_core.components import ACTIONS, components
from pipelines.intake.header import judge_header
from pipelines.intake.landing import LandingFile
from pipelines.intake.ledger import Fault, quarantine
from pipelines.intake.names import EARLIEST, MAX_PACKS, flight_day, flight_tail, is_operator, is_tail
from pipelines.intake.parquet import parquet_as_text
from pipelines.intake.row_validation import PACKS
from pipelines.intake.text import Text, open_text
from pipelines.intake.text_columns import to_columns
from pipelines.intake.times import to_day, to_utc, zone_note

COMPONENTS = (*components(), "RAM_DOOR", "SENSOR")
SERIALS = ("serial_off", "serial_on")
FINDINGS = ("FOULED", "CLOGGED", "CORRODED", "DAMAGED", "NO_FAULT_FOUND")

_UTC = pl.Datetime("us", "UTC")
Schema = dict[str, pl.DataType | type[pl.DataType]]
_KEYS: Schema = {"operator": pl.String, "tail": pl.String}
MESSAGES: Schema = {
    **_KEYS,
    "message_time": _UTC,
    "flight_id": pl.String,
    "pack": pl.Int32,
    "code": pl.String,
    "text": pl.String,
}
MAINTENANCE: Schema = {**_KEYS, "done_on": pl.Date, "pack": pl.Int32, "component": pl.String, "action": pl.String,
               "finding": pl.String, "reference": pl.String, "done_at": _UTC, "serial_off": pl.String,
               "serial_on": pl.String}  # fmt: skip
CHECKS: Schema = {**_KEYS, "planned_on": pl.Date, "name": pl.String}
FARTHEST = timedelta(days=3660)
FLEET: Schema = {**_KEYS, "msn": pl.String, "delivered_on": pl.Date, "packs": pl.Int32, "type": pl.String}

Row = tuple[object, ...]
Words = dict[str, str]
"""Fields of a line by column, stripped; empty where the file has no such column."""


@dataclass(frozen=True, slots=True)
class Log:
    """Rows of a log, each once; what is wrong with it; `n_delivered` = rows + `n_duplicate` + quarantined `n_rows`."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    n_delivered: int
    n_duplicate: int

    @property
    def n_loaded(self) -> int:
        """Rows stored."""
        return self.rows.height


def read_messages(file: LandingFile, now: datetime, fleet: pl.DataFrame | None = None) -> Log:
    """Maintenance messages of one aircraft: `operator, tail, message_time, flight_id, pack, code, text`.

    The `fleet` list says how many packs it has; two where it does not.
    """
    packs, _ = _listed(file, fleet)

    def judge(words: Words, moment: datetime | None) -> Row | Fault:
        pack = _pack(words["pack"], packs)
        if fault := bad_moment(moment, now, "message_time") or _bad_flight(words["flight_id"], file.tail):
            return fault
        if pack == 0:
            return Fault("bad_pack", column_name="pack")
        if not re.fullmatch(r"[A-Z0-9][A-Z0-9-]{1,31}", words["code"], re.ASCII):
            return Fault("bad_code", column_name="code")
        return (
            file.operator,
            file.tail,
            moment,
            words["flight_id"] or None,
            pack,
            words["code"],
            words["text"] or None,
        )

    return _read(file, judge, MESSAGES, ("message_time", "flight_id", "pack", "code"), ("text",), timed="message_time")


def read_maintenance(file: LandingFile, now: datetime, fleet: pl.DataFrame | None = None) -> Log:
    """Work done on one aircraft: the columns of `MAINTENANCE`.

    `done_on` may give a day or a time of day; `done_at` keeps the time. Work from before the first flight in store is
    as good as any; from before the aircraft was delivered it is noted.
    """
    packs, delivered_on = _listed(file, fleet)
    early: list[date] = []

    def judge(words: Words, moment: datetime | None) -> Row | Fault:
        day, pack = moment.date() if moment else to_day(words["done_on"]), _pack(words["pack"], packs)
        if fault := bad_moment(moment, now, "done_on") if moment else bad_moment(day, now.date(), "done_on"):
            return fault
        early.extend([day] if delivered_on and day and day < delivered_on else [])
        if pack == 0:
            return Fault("bad_pack", column_name="pack")
        codes = {c: words[c].upper() for c in ("component", "action", "finding")}
        agreed = {"component": COMPONENTS, "action": ACTIONS, "finding": ("", *FINDINGS)}
        if odd := [c for c, code in codes.items() if code not in agreed[c]]:
            return Fault("bad_code", column_name=", ".join(odd))
        finding = codes["finding"] or None
        return (
            file.operator,
            file.tail,
            day,
            pack,
            codes["component"],
            codes["action"],
            finding,
            words["reference"] or None,
            moment,
            words["serial_off"] or None,
            words["serial_on"] or None,
        )

    required = ("done_on", "pack", "component", "action")
    log = _read(file, judge, MAINTENANCE, required, ("finding", "reference"), timed="done_on", extra=SERIALS)
    if not early:
        return log
    said = f"Delivered on {delivered_on}; work of {', '.join(sorted({f'{day}' for day in early})[:5])}."
    note = quarantine(file.path, file.received_at, [Fault("before_delivery", column_name="done_on", detail=said)])
    return replace(log, quarantine=pl.concat([log.quarantine, note]))


def _listed(file: LandingFile, fleet: pl.DataFrame | None) -> tuple[int, date | None]:
    """Packs of the file's aircraft and the day it was delivered, as far as the fleet list knows it."""
    for row in () if fleet is None else fleet.filter(operator=file.operator, tail=file.tail).iter_rows(named=True):
        return row["packs"] or PACKS, row.get("delivered_on")
    return PACKS, None


def read_fleet(file: LandingFile, now: datetime) -> Log:
    """The fleet list: `operator, tail, msn, delivered_on, packs, type`; of an aircraft's lines the first counts."""

    def judge(words: Words, _: datetime | None) -> Row | Fault:
        if not is_operator(words["operator"]) or not is_tail(words["tail"]):
            return Fault("bad_key", column_name="operator, tail")
        day = to_day(words["delivered_on"])
        if words["delivered_on"] and day is None:
            return Fault("unreadable_time", column_name="delivered_on")
        packs = words["packs"] or str(PACKS)
        if packs not in {str(n) for n in range(1, MAX_PACKS + 1)}:
            return Fault("bad_pack", column_name="packs")
        return (words["operator"], words["tail"], words["msn"] or None, day, int(packs), words["type"] or None)

    return _read(file, judge, FLEET, ("operator", "tail"), ("msn", "delivered_on", "packs", "type"), unique=2)


def read_checks(file: LandingFile, now: datetime) -> Log:
    """Planned checks: `operator, tail, planned_on, name`; from CSV or Parquet, columns `operator, tail, date, name`."""

    def judge(words: Words, _: datetime | None) -> Row | Fault:
        if not is_operator(words["operator"]) or not is_tail(words["tail"]):
            return Fault("bad_key", column_name="operator, tail")
        day = to_day(words["date"])
        if day is None or not EARLIEST <= day <= now.date() + FARTHEST:
            return Fault("unreadable_time", column_name="date", detail="A day (2024-06-19) within the next ten years.")
        return (words["operator"], words["tail"], day, words["name"] or "check")

    required = ("operator", "tail", "date")
    if file.is_text:
        return _read(file, judge, CHECKS, required, (), extra=("name",))
    log = _read(file, judge, CHECKS, required, (), extra=("name",), convert=parquet_as_text)
    return replace(log, quarantine=log.quarantine.with_columns(pl.col("row") - 1))  # no header stands before row 1


def _read(
    file: LandingFile,
    judge: Callable[[Words, datetime | None], Row | Fault],
    schema: Schema,
    required: tuple[str, ...],
    optional: tuple[str, ...],
    *,
    timed: str | None = None,
    unique: int = 0,
    extra: tuple[str, ...] = (),
    convert: Callable[[bytes], tuple[bytes | None, list[Fault]]] | None = None,
) -> Log:
    """Open a log, judge its lines, drop those that stand twice; with `unique`, so many leading fields are a key."""
    content, faults = file.read()
    if content is not None and convert:
        content, faults = convert(content)
    if content is None:
        return Log(pl.DataFrame(schema=schema), quarantine(file.path, file.received_at, faults), 0, 0)
    text = open_text(content, lambda found: judge_header(found, required, optional, extra=extra))
    lines, line_faults = to_columns([text], ())
    nothing_happened = () if unique else ("no_rows",)  # an aircraft without messages has a log of a header alone
    faults = [f for f in (*text.faults, *line_faults[0]) if f.reason not in nothing_happened]
    good: dict[Row, int] = {}
    for row, words, moment in _lines(lines, (*required, *optional, *extra), timed, faults):
        verdict = judge(words, moment)
        if isinstance(verdict, Fault):
            faults.append(_placed(verdict, row, text))
        else:
            good.setdefault(verdict, row)
    n_duplicate = text.n_rows - len(good) - sum(f.n_rows for f in faults)
    kept = _one_a_key(good, unique, text, faults)
    rows = pl.DataFrame(kept, schema=schema, orient="row")
    return Log(rows, quarantine(file.path, file.received_at, faults), text.n_rows, n_duplicate)


def _lines(
    lines: pl.DataFrame, columns: tuple[str, ...], timed: str | None, faults: list[Fault]
) -> list[tuple[int, Words, datetime | None]]:
    if lines.is_empty():
        return []
    moments: list[datetime | None] = [None] * lines.height
    if timed is not None:
        parsed, naive = to_utc(lines.select(timed, "row"), timed)
        moments = parsed.get_column(timed).to_list()
        faults.extend(zone_note(naive, timed))
    rows = lines.iter_rows(named=True)
    return [(r["row"], {c: printable(r.get(c)) for c in columns}, m) for r, m in zip(rows, moments, strict=True)]


def printable(field: str | None) -> str:
    """A field without what can't be printed, cut at 500 characters."""
    return "".join(c for c in (field or "").strip() if c.isprintable())[:500]


def _placed(fault: Fault, row: int, text: Text) -> Fault:
    return Fault(fault.reason, row, fault.column_name, fault.detail, 1, content=text.line(row))


def _one_a_key(good: dict[Row, int], unique: int, text: Text, faults: list[Fault]) -> list[Row]:
    """Rows in order; of several with the same leading `unique` fields the first in order, the others to the faults."""
    kept: dict[Row, Row] = {}
    for row in sorted(good, key=lambda r: tuple((f is None, str(f)) for f in r)):
        key = row[:unique] if unique else row
        if key in kept:
            faults.append(_placed(Fault("bad_key", detail="Listed twice with other values."), good[row], text))
        else:
            kept[key] = row
    return list(kept.values())


def _pack(word: str, packs: int) -> int | None:
    """Pack number, None where none is given, 0 where it is none."""
    if not word:
        return None
    return int(word) if word in {str(n) for n in range(1, packs + 1)} else 0


def bad_moment(moment: date | None, now: date, column: str) -> Fault | None:
    """What is wrong with a day or a time, by what is now of the same kind."""
    if moment is None:
        return Fault("unreadable_time", column_name=column)
    if (moment.date() if isinstance(moment, datetime) else moment) < EARLIEST:
        return Fault("too_early", column_name=column)
    return Fault("future_time", column_name=column) if moment > now else None


def _bad_flight(flight: str, tail: str) -> Fault | None:
    if not flight:
        return None
    if flight_day(flight) is None:
        return Fault("bad_flight_id", column_name="flight_id")
    return None if flight_tail(flight) == tail else Fault("flight_id_contradicts_path", column_name="flight_id")
