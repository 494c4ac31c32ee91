"""Read the lists and logs beside the recorder files: fleet list, messages, maintenance, planned checks.

Each line is validated by itself and stored once.
"""

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import polars as pl

from hdt_core.components import ACTIONS, components
from hdt_core.components.declaration import FINDINGS
from hdt_core.tables.raw import CLOSES, RawChecks, RawFleet, RawMaintenance, RawMessages
from pipelines.intake.columns import Contract
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import (
    DAY,
    EARLIEST,
    MAX_PACKS,
    PACKS,
    FileIntake,
    LandingFile,
    flight_day,
    flight_tail,
    is_operator,
    is_tail,
    to_day,
    to_utc,
    zone_note,
)
from pipelines.intake.text import Text, open_text, to_columns

Row = tuple[object, ...]
Words = dict[str, str]
"""Fields of a line by column, stripped; empty where the file has no such column."""


@dataclass(frozen=True, slots=True)
class Lines:
    """Good lines, each once; faults of the others; the numbers of delivered and duplicate lines."""

    rows: list[Row]
    faults: list[Fault]
    n_delivered: int
    n_duplicate: int


def parse_list(
    content: bytes,
    contract: Contract,
    validate: Callable[[Words, datetime | None], Row | Fault],
    time: str = "",
    n_key: int = 0,
    midnight_is_day: bool = False,
) -> Lines:
    """Open a list, validate its lines and drop duplicates.

    `time` is the column of times, which are parsed in bulk. The first `n_key` fields are a key: of several lines with
    one key the first counts; 0: whole lines are compared. With `midnight_is_day` a midnight is read as its day alone.
    """
    text = open_text(content, contract)
    lines = to_columns([text], ())
    if midnight_is_day and time in lines.columns:
        lines = lines.with_columns(pl.col(time).str.replace(DAY, "${day}"))
    harmless = () if n_key else ("no_rows",)  # an aircraft without messages has a header alone
    faults = [f for f in text.faults if f.reason not in harmless]
    good: dict[Row, int] = {}
    for row, words, moment in _words(lines, contract, time, faults):
        result = validate(words, moment)
        if isinstance(result, Fault):
            faults.append(_row_fault(result, row, text))
        else:
            good.setdefault(result, row)
    n_duplicate = text.n_rows - len(good) - sum(f.n_rows for f in faults)
    rows = _first_of_key(good, n_key, text, faults) if n_key else sorted(good, key=_sort_key)
    return Lines(rows, faults, text.n_rows, n_duplicate)


def _words(
    lines: pl.DataFrame, contract: Contract, time: str, faults: list[Fault]
) -> Iterator[tuple[int, Words, datetime | None]]:
    """Yield number, fields and time of each line; a note on times without zone goes to the faults."""
    moments: list[datetime | None] = [None] * lines.height
    if time and lines.height:
        times, naive = to_utc(lines.select(time, "row"), time)
        moments = times[time].to_list()
        faults.extend(zone_note(naive, time))
    names = (*contract.keys, *contract.words, *contract.extra)
    for line, moment in zip(lines.iter_rows(named=True), moments, strict=True):
        yield line["row"], {name: printable(line.get(name)) for name in names}, moment


def printable(field: str | None) -> str:
    """Strip a field of non-printable characters, with a space for each line break, and cut it at 500."""
    line = " ".join((field or "").split("\n"))
    return "".join(c for c in line.strip() if c.isprintable())[:500]


def _row_fault(fault: Fault, row: int, text: Text) -> Fault:
    return replace(fault, row=row, n_rows=1, content=text.line(row))


def _sort_key(row: Row) -> tuple[tuple[bool, str], ...]:
    return tuple((field is None, str(field)) for field in row)


def _first_of_key(good: dict[Row, int], n_key: int, text: Text, faults: list[Fault]) -> list[Row]:
    """Keep the first of rows with the same leading fields; the others go to the faults."""
    first: dict[Row, Row] = {}
    for row, line in sorted(good.items(), key=lambda item: item[1]):
        if row[:n_key] in first:
            detail = f"Listed twice with other values; line {good[first[row[:n_key]]]} counts."
            faults.append(_row_fault(Fault("bad_key", detail=detail), line, text))
        else:
            first[row[:n_key]] = row
    return list(first.values())


CONTRACT = Contract(("operator", "tail"), ("msn", "delivered_on", "packs", "type"), extra=("valid_from", "valid_to"))


@dataclass(frozen=True, slots=True)
class FleetLine:
    """A line of the list: an airframe (`msn`) under one operator and tail.

    `type` is empty where its files are the default record; dates are null where they are open.
    """

    operator: str
    tail: str
    msn: str | None = None
    valid_from: date | None = None
    valid_to: date | None = None
    delivered_on: date | None = None
    packs: int = PACKS
    type: str = ""

    @property
    def folder(self) -> tuple[str, str]:
        """Operator and tail."""
        return self.operator, self.tail


FleetLines = dict[tuple[str, str], list[FleetLine]]
"""Lines of each operator and tail, in the order of the list."""


def parse_fleet(content: bytes) -> Lines:
    """Parse the first good line of each operator, tail, msn and begin as `FleetLine` has it; faults of the others."""
    return parse_list(content, CONTRACT, _validate_aircraft, n_key=4)


def _validate_aircraft(words: Words, _: datetime | None) -> Row | Fault:
    if not is_operator(words["operator"]) or not is_tail(words["tail"]):
        return Fault("bad_key", column_name="operator, tail")
    days = {name: to_day(words[name]) for name in ("valid_from", "valid_to", "delivered_on")}
    if odd := [name for name, day in days.items() if words[name] and day is None]:
        return Fault("unreadable_time", column_name=", ".join(odd))
    if days["valid_from"] and days["valid_to"] and days["valid_to"] < days["valid_from"]:
        return Fault("ends_before_start", column_name="valid_from, valid_to")
    packs = _number_up_to(MAX_PACKS, words["packs"] or str(PACKS))
    if packs == 0:
        return Fault("bad_pack", column_name="packs")
    return (words["operator"], words["tail"], words["msn"] or None, *days.values(), packs, words["type"])


def fleet_lines(landing: Path) -> FleetLines:
    """Read the lines by operator and tail; none where the list can't be read, which its intake reports."""
    path = landing / "fleet.csv"
    return _lines(path, path.stat().st_ctime_ns) if path.is_file() else {}


@lru_cache(maxsize=8)
def _lines(path: Path, _changed_ns: int) -> FleetLines:
    try:
        rows: list[Any] = parse_fleet(path.read_bytes()).rows
    except OSError:
        return {}
    lines = FleetLines()
    for row in rows:
        line = FleetLine(*row)
        lines.setdefault(line.folder, []).append(line)
    return lines


COMPONENTS = (*components(), "RAM_DOOR", "SENSOR")
SERIALS = ("serial_off", "serial_on")
OWN_CODES = frozenset(part.message_code for part in components().values())
"""Codes of the messages that the components' failures raise."""
STATUS = "status"
STATUS_NAMES = (STATUS, "wo_status", "work_status", "order_status", "task_status")
"""The column as systems of maintenance export it; left out, work that was cancelled would count as done."""
DONE = ("", "COMPLETED", "CLOSED", "DONE")
"""Statuses of a line of the maintenance log whose work was done; any other is of work that is planned or cancelled."""
NOT_DONE = ("CANCELLED", "CANCELED", "OPEN", "DEFERRED", "PLANNED", "SCHEDULED", "PENDING")
"""Statuses that are known to be of such work; another gets a note."""
FARTHEST = timedelta(days=3660)


def read_messages(file: LandingFile, now: datetime) -> FileIntake:
    """Read maintenance messages of one aircraft: the columns of `raw_messages`."""
    later = list[datetime]()
    no_pack = list[date]()

    def validate(words: Words, moment: datetime | None) -> Row | Fault:
        pack = _number_up_to(file.packs, words["pack"])
        if fault := time_fault(moment, now, "message_time"):
            later.extend([moment] if moment and moment > now else [])
            return fault
        if fault := _flight_fault(words["flight_id"], file.tail):
            return fault
        if pack == 0:
            return Fault("bad_pack", column_name="pack")
        if not re.fullmatch(r"[A-Z0-9][A-Z0-9-]{1,31}", words["code"], re.ASCII):
            return Fault("bad_code", column_name="code")
        flight = words["flight_id"] or None
        text = words["text"] or None
        no_pack.extend([moment.date()] if moment and pack is None and words["code"] in OWN_CODES else [])
        return file.operator, file.tail, moment, flight, pack, words["code"], file.path, text

    contract = Contract(("message_time", "flight_id", "pack", "code"), ("text",))
    log = _read_log(
        file, RawMessages.create_empty(), lambda content: parse_list(content, contract, validate, "message_time")
    )
    log = replace(log, due_at=min(later, default=None))
    return _with_notes(file, log, _note_on("no_pack", "pack", "Messages of", no_pack))


def read_maintenance(file: LandingFile, now: datetime) -> FileIntake:
    """Read the work done on one aircraft: the columns of `raw_maintenance`.

    `done_on` may give a day, also as its midnight, or a time of day; `done_at` keeps the time. Work before the first
    stored flight counts as any other; work before the aircraft's delivery gets a note. Work that was not done by its
    `status` may lie ahead.
    """
    delivered_on = file.delivered_on
    early = list[date]()
    later = list[datetime]()
    no_pack = list[date]()
    unknown_status = defaultdict[str, list[date]](list)

    def validate(words: Words, moment: datetime | None) -> Row | Fault:
        day = moment.date() if moment else to_day(words["done_on"])
        pack = _number_up_to(file.packs, words["pack"])
        status = next((words[name].upper() for name in STATUS_NAMES if words[name]), "")
        ahead = timedelta(0) if status in DONE else FARTHEST
        latest = now + ahead
        if fault := time_fault(moment, latest, "done_on") if moment else time_fault(day, latest.date(), "done_on"):
            later.extend([(moment or start_of(day)) - ahead] if day and fault.reason == "future_time" else [])
            return fault
        early.extend([day] if delivered_on and day and day < delivered_on else [])
        if pack == 0:
            return Fault("bad_pack", column_name="pack")
        codes = {c: words[c].upper() for c in ("component", "action", "finding")}
        codes_agreed = {"component": COMPONENTS, "action": ACTIONS, "finding": ("", *FINDINGS)}
        if odd := [c for c, code in codes.items() if code not in codes_agreed[c]]:
            return Fault("bad_code", column_name=", ".join(odd))
        no_pack.extend([day] if day and pack is None and codes["component"] in components() else [])
        if day and status not in DONE + NOT_DONE:
            unknown_status[status].append(day)
        finding = codes["finding"] or None
        reference = words["reference"] or None
        serials = (words[name] or None for name in SERIALS)
        return (file.operator, file.tail, day, pack, codes["component"], codes["action"], finding, reference, moment,
                *serials, status or None, file.path)  # fmt: skip

    no_work = pl.DataFrame(schema=RawMaintenance.types("counts_from", "source", "since_night", *CLOSES))
    extra = (*SERIALS, *STATUS_NAMES)
    contract = Contract(("done_on", "pack", "component", "action"), ("finding", "reference"), extra=extra)
    parse = partial(parse_list, contract=contract, validate=validate, time="done_on", midnight_is_day=True)
    log = _read_log(file, no_work, parse)
    log = replace(log, due_at=min(later, default=None))
    notes = _note_on("before_delivery", "done_on", f"Delivered on {delivered_on}; work of", early)
    notes += _note_on("no_pack", "pack", "Work of", no_pack)
    for status, days in sorted(unknown_status.items()):
        notes += _note_on("unknown_status", STATUS, f"{status}: work of", days)
    return _with_notes(file, log, notes)


def _note_on(reason: str, column: str, what: str, days: Collection[date]) -> list[Fault]:
    """Make a note that names the first of some days; none without a day."""
    first = ", ".join(sorted({f"{day}" for day in days})[:5])
    return [Fault(reason, column_name=column, detail=f"{what} {first}.")] if days else []


def _with_notes(file: LandingFile, log: FileIntake, notes: list[Fault]) -> FileIntake:
    return replace(log, quarantine=pl.concat([log.quarantine, file.quarantine(notes)])) if notes else log


def is_done() -> pl.Expr:
    """Whether the work of a row of the maintenance log was done."""
    return pl.col(STATUS).fill_null("").is_in(DONE)


def read_fleet(file: LandingFile, now: datetime) -> FileIntake:
    """Read the fleet list: the columns of `FleetLine`, as in `raw_fleet`."""
    schema = {name: RawFleet.types()[name] for name in FleetLine.__slots__}
    return _read_log(file, pl.DataFrame(schema=schema), parse_fleet)


def read_checks(file: LandingFile, now: datetime) -> FileIntake:
    """Read planned checks from CSV or Parquet with the columns `operator, tail, date, name`."""
    later = list[datetime]()

    def validate(words: Words, _: datetime | None) -> Row | Fault:
        if not is_operator(words["operator"]) or not is_tail(words["tail"]):
            return Fault("bad_key", column_name="operator, tail")
        day = to_day(words["date"])
        if day is not None and day > now.date() + FARTHEST:
            later.append(start_of(day) - FARTHEST)
        if day is None or not EARLIEST <= day <= now.date() + FARTHEST:
            return Fault("unreadable_time", column_name="date", detail="A day (2024-06-19) within the next ten years.")
        return (words["operator"], words["tail"], day, words["name"] or "check")

    contract = Contract(("operator", "tail", "date"), extra=("name",))
    log = _read_log(file, RawChecks.create_empty(), lambda content: parse_list(content, contract, validate))
    log = replace(log, due_at=min(later, default=None))
    if file.is_text:
        return log
    return replace(log, quarantine=log.quarantine.with_columns(pl.col("row") - 1))  # no header precedes row 1


def _read_log(file: LandingFile, no_rows: pl.DataFrame, parse: Callable[[bytes], Lines]) -> FileIntake:
    """Open a log and validate its lines; of checks in Parquet the rows as lines of text."""
    content, faults = file.read_content()
    if content is not None and file.kind == "checks" and not file.is_text:
        from pipelines.intake.parquet import parquet_as_text  # pyarrow

        content, parquet_faults = parquet_as_text(content)
        faults = [*faults, *parquet_faults]
    if content is None:
        return FileIntake(no_rows, file.quarantine(faults), 0, 0)
    lines = parse(content)
    rows = pl.DataFrame(lines.rows, schema=no_rows.schema, orient="row")
    return FileIntake(rows, file.quarantine([*faults, *lines.faults]), lines.n_delivered, lines.n_duplicate)


def or_stored(intake: FileIntake, stored: pl.DataFrame) -> FileIntake:
    """Return what was read of a log, or the rows `stored` of its earlier version where it has no good row now."""
    if intake.rows.height:
        return intake
    rows = pl.concat([intake.rows.clear(), stored], how="diagonal").select(intake.rows.columns)  # of an older version
    return replace(intake, rows=rows, n_delivered=intake.n_delivered + rows.height)


def _number_up_to(last: int, word: str) -> int | None:
    """Parse a number from 1 to `last`, also as `1.0`; None where the field is empty, 0 where it is no such number.

    Data frames write a column of whole numbers with an empty cell as decimals.
    """
    if not word:
        return None
    whole = re.sub(r"\.0*$", "", word)
    return int(whole) if whole in {str(n) for n in range(1, last + 1)} else 0


def time_fault(moment: date | None, now: date, column: str) -> Fault | None:
    """Check a day or a time against `now` of the same kind."""
    if moment is None:
        return Fault("unreadable_time", column_name=column)
    if (moment.date() if isinstance(moment, datetime) else moment) < EARLIEST:
        return Fault("too_early", column_name=column)
    return Fault("future_time", column_name=column) if moment > now else None


def start_of(day: date) -> datetime:
    """Return the first moment of a day, UTC."""
    return datetime(day.year, day.month, day.day, tzinfo=UTC)


def _flight_fault(flight: str, tail: str) -> Fault | None:
    if not flight:
        return None
    if flight_day(flight) is None:
        return Fault("bad_flight_id", column_name="flight_id")
    return None if flight_tail(flight) == tail else Fault("flight_id_contradicts_path", column_name="flight_id")
