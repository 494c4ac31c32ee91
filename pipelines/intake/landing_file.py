"""Describe one file of the landing zone (aircraft, kind, how it is read); check delivered names and parse times.

Times are ISO 8601 with Z, an offset or neither.
"""

import hashlib
import re
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, date, datetime
from io import BufferedReader
from typing import Literal, NamedTuple

import polars as pl

from hdt_core.tables.base import FLIGHT_ID, OPERATOR, TAIL
from pipelines.intake.faults import Fault, quarantine

PACKS = 2
"""Packs of an aircraft that is not in the fleet list."""
MAX_PACKS = 4
EARLIEST = date(1980, 1, 7)
"""A clock that was never set gives 1970, or 6 January 1980 where it is GPS; an older date is a typing error."""
_OPERATOR, _TAIL, _FLIGHT_ID = (re.compile(p, re.ASCII) for p in (OPERATOR, TAIL, FLIGHT_ID))
_HISTORY = re.compile(r"history_\d{4}-\d{2}\.parquet", re.ASCII)


def is_operator(name: str) -> bool:
    """Return whether `name` is that of an operator."""
    return _OPERATOR.fullmatch(name) is not None


def is_tail(name: str) -> bool:
    """Return whether `name` is a registration."""
    return _TAIL.fullmatch(name) is not None


def is_history(name: str) -> bool:
    """Return whether `name` is that of a history file."""
    return _HISTORY.fullmatch(name) is not None


def flight_day(flight_id: str) -> date | None:
    """Parse the UTC day of departure of a flight_id; None where it is none: bad pattern, no such day, leg 00.

    Examples
    --------
    >>> flight_day("LX-AAA_20240229_01")
    datetime.date(2024, 2, 29)
    >>> flight_day("LX-AAA_20230229_01"), flight_day("../X_20240101_01"), flight_day("LX-AAA_20240101_00")
    (None, None, None)
    """
    if _FLIGHT_ID.fullmatch(flight_id) is None or flight_id.endswith("_00"):
        return None
    digits = flight_id[-11:-3]
    try:
        return date(int(digits[:4]), int(digits[4:6]), int(digits[6:]))
    except ValueError:
        return None


def flight_tail(flight_id: str) -> str:
    """Return the tail of a well-formed flight_id."""
    return flight_id[:-12]


def flight_of_file(name: str, tail: str) -> str | None:
    """Return the flight that a file is named after; None where the name is no flight_id of this tail."""
    stem = name.rpartition(".")[0]
    return stem if flight_day(stem) is not None and flight_tail(stem) == tail else None


_CONTRACT = "%Y-%m-%dT%H:%M:%SZ"
_ISO = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d([.,]\d{1,9})?)?(Z|[+-]\d\d(:?\d\d)?)?", re.ASCII)


def to_utc(frame: pl.DataFrame, name: str) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Parse the text column `name` as UTC times, null where unreadable; also the rows whose time has no zone.

    The contract's own format is parsed in bulk; any other ISO 8601 format value by value. A fraction is kept to the
    microsecond, an offset is converted, a time without either counts as UTC.
    """
    if frame.schema[name] != pl.String:
        return frame, frame.clear()
    bulk = pl.col(name).str.to_datetime(_CONTRACT, strict=False, time_unit="us", time_zone="UTC")
    with_times = frame.with_columns(bulk.alias("_time"))
    others = with_times.filter(pl.col("_time").is_null() & pl.col(name).is_not_null())
    naive = frame.clear()
    if others.height:
        texts = others.get_column(name).unique().to_list()
        moments = [_moment(text) for text in texts]
        schema = {name: pl.String(), "_other": pl.Datetime("us", "UTC"), "_naive": pl.Boolean()}
        other = pl.DataFrame([(t, *m) for t, m in zip(texts, moments, strict=True)], schema=schema, orient="row")
        with_times = with_times.join(other, on=name, how="left", maintain_order="left", validate="m:1")
        naive = with_times.filter(pl.col("_naive").fill_null(False)).select(frame.columns)
        with_times = with_times.with_columns(pl.coalesce("_time", "_other").alias("_time"))
    return with_times.select(pl.col("_time").alias(name) if c == name else c for c in frame.columns), naive


def _moment(text: str) -> tuple[datetime | None, bool]:
    """Parse a text as UTC time, None where it is none; and whether it has no zone."""
    text = text.strip()
    if _ISO.fullmatch(text) is None:
        return None, False
    try:
        moment = datetime.fromisoformat(text.replace(",", "."))
        naive = moment.tzinfo is None
        return (moment.replace(tzinfo=UTC) if naive else moment.astimezone(UTC)), naive
    except (ValueError, OverflowError):
        return None, False


DAY = r"^\s*(?P<day>[0-9]{4}-[0-9]{2}-[0-9]{2})([T ]00:00(:00([.,]0+)?)?(Z|[+-][0-9]{2}(:?[0-9]{2})?)?)?\s*$"
"""A day, also as its midnight: so spreadsheets and databases write it."""


def to_day(text: str | None) -> date | None:
    """Parse an ISO 8601 date, or its midnight; None where it is none."""
    parsed = re.match(DAY, text or "")
    try:
        return date.fromisoformat(parsed["day"]) if parsed else None
    except ValueError:
        return None


def zone_note(naive: pl.DataFrame, name: str) -> list[Fault]:
    """Make one note for the rows whose time has no zone."""
    return [Fault("time_without_zone", column_name=name, detail=f"Rows: {naive.height}.")] if naive.height else []


Aircraft = tuple[str, str]
"""Operator and tail, of a folder or as the key of an airframe."""


@dataclass(frozen=True, slots=True)
class Tenure:
    """The airframe that an operator and tail belonged to from a day on."""

    since: date
    airframe: Aircraft
    """Key of the airframe."""
    prefix: str = ""
    """What its flights' ids begin with as stored: the operator, where the airframe had this tail under another one."""

    def __str__(self) -> str:
        return ",".join((str(self.since), *self.airframe, self.prefix))


Kind = Literal[
    "acms", "history", "cpl", "component", "recorder", "reports", "type", "messages", "maintenance", "fleet", "checks"
]
RECORDER = "recorder"
"""Folder of an aircraft that holds recordings."""
UNREAD = ("cannot_open", "changed_since_scan")
"""Faults of a file that was not read as it was registered; later nights try it again."""
MAX_TEXT_BYTES = 64 << 20
MAX_PARQUET_BYTES = 256 << 20
"""A flight's report is kilobytes, a month of them or a 1 Hz log a few megabytes; larger files are not read."""


@dataclass(frozen=True, slots=True)
class LandingFile:
    """One file of the landing zone, as it was when the zone was listed."""

    landing: str
    path: str
    """Path below the landing zone, with forward slashes: the file's name in ledger and quarantine."""
    operator: str
    tail: str
    kind: Kind
    size: int
    mtime_ns: int
    touched_ns: int = 0
    """When content or modification time were last set, by the file system's clock, which no program sets back."""
    context: str = ""
    """What determines, beside its content, how it is read; see `landing.reading_context`."""
    in_fleet_list: bool = True
    """Whether the fleet list has a line of its aircraft; otherwise the recorded context of a file stays valid."""
    packs_stored: int = 0
    """Packs that are stored of it; the fleet list can't reduce them."""
    content_hash: str = ""
    """Hash of the content that was registered; empty where none is known."""

    @property
    def packs(self) -> int:
        """Packs of its aircraft."""
        return max(self.packs_listed, self.packs_stored)

    @property
    def packs_listed(self) -> int:
        """Packs by the fleet list; two where it names none."""
        return int(self._word("packs") or PACKS)

    @property
    def apart(self) -> list[Aircraft]:
        """Operators and tails that are airframes of their own by their flights, of the fleet list."""
        words = (self._word("apart") or "").split(",")
        return [(operator, tail) for operator, _, tail in (word.partition(":") for word in words if word)]

    @property
    def delivered_on(self) -> date | None:
        """Day on which its aircraft was delivered, of a maintenance log."""
        day = self._word("delivered_on")
        return date.fromisoformat(day) if day else None

    @property
    def other_operators(self) -> str | None:
        """None where the fleet list has the aircraft; else operators under which it has the tail."""
        return self._word("unlisted")

    @property
    def tenures(self) -> list[Tenure]:
        """Airframes that its operator and tail belonged to, the first from the beginning."""
        words = (word.split(",") for word in (self._word("airframe") or "").split(";") if word)
        tenures = [Tenure(date.fromisoformat(since), (o, t), prefix) for since, o, t, prefix in words]
        return tenures or [Tenure(date.min, (self.operator, self.tail))]

    def tenure(self, day: date) -> Tenure:
        """Return the airframe that its operator and tail belonged to on a day."""
        return [t for t in self.tenures if t.since <= day][-1]

    def _word(self, name: str) -> str | None:
        return dict(word.split("=", 1) for word in self.context.split()).get(name)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.path.rpartition("/")[2]

    @property
    def flight(self) -> str | None:
        """Flight that it is named after; None where its name is no flight_id of its tail."""
        return flight_of_file(self.name, self.tail)

    @property
    def is_text(self) -> bool:
        """Whether it is read as text and not as Parquet, by its name."""
        return self.path.lower().endswith(".csv")

    @property
    def source(self) -> str:
        """Where its rows come from: snapshot reports or a continuous log."""
        return "cpl" if "/cpl/" in self.path or self.is_recording else "acms"

    @property
    def is_recording(self) -> bool:
        """Whether it is a flight recorder's own file, which a package's reader turns into rows."""
        return self.folder == RECORDER

    @property
    def folder(self) -> str:
        """Folder that holds it."""
        return self.path.rpartition("/")[0].rpartition("/")[2]

    @property
    def full_path(self) -> str:
        """Absolute path."""
        return f"{self.landing}/{self.path}"

    def quarantine(self, faults: Iterable[Fault]) -> pl.DataFrame:
        """Turn faults of the file into quarantine rows."""
        return quarantine(self.path, self.received_at, faults)

    def read_content(self) -> tuple[bytes | None, list[Fault]]:
        """Read the content; None and the fault where that fails."""
        limit = MAX_TEXT_BYTES if self.is_text else MAX_PARQUET_BYTES
        try:
            with open(self.full_path, "rb") as source:
                content = source.read(limit + 1)  # it may have grown since it was listed
        except OSError as error:
            return None, [Fault("cannot_open", detail=error.strerror or type(error).__name__)]
        if len(content) > limit:
            return None, [Fault("too_large", detail=f"It has more than {limit >> 20} MiB.")]
        return content, self._compare_hash(hash_of(content))

    def find_change(self) -> list[Fault]:
        """Compare the file with what was registered, for a reader that opens it by itself; the fault if it differs."""
        try:
            with open(self.full_path, "rb") as source:
                return self._compare_hash(hash_of(source))
        except OSError as error:
            return [Fault("cannot_open", detail=error.strerror or type(error).__name__)]

    def _compare_hash(self, content_hash: str) -> list[Fault]:
        return [] if self.content_hash in ("", content_hash) else [Fault("changed_since_scan")]

    @property
    def received_at(self) -> datetime:
        """When it was last written."""
        return modified_at(self.mtime_ns)


class Registered(NamedTuple):
    """What the ledger's digest of a file says: hash of the content, when to read it again (ISO 8601), its context.

    The hash is empty where the file could not be read as it was registered. A time is there where rows were refused
    because they lay after the clock's time.
    """

    content_hash: str
    due_at: str
    context: str

    @classmethod
    def parse(cls, digest: str) -> "Registered":
        """Parse a digest of the ledger."""
        content, _, context = digest.partition(" ")
        content_hash, _, due_at = content.partition("@")
        return cls(content_hash, due_at, context)

    def __str__(self) -> str:
        """Format the digest."""
        content = f"{self.content_hash}@{self.due_at}" if self.due_at else self.content_hash
        return f"{content} {self.context}" if self.context else content

    def is_due(self, now: datetime) -> bool:
        """Whether rows that were refused for their time can be stored by now."""
        return bool(self.due_at) and datetime.fromisoformat(self.due_at) <= now


def hash_of(content: bytes | BufferedReader) -> str:
    """Hash the content of a file, given as bytes or opened."""
    if isinstance(content, bytes):
        return hashlib.blake2b(content).hexdigest()[:32]
    return hashlib.file_digest(content, "blake2b").hexdigest()[:32]


def modified_at(mtime_ns: int) -> datetime:
    """Convert the modification time of a file to UTC, to the second."""
    return datetime.fromtimestamp(mtime_ns // 1_000_000_000, UTC)


@dataclass(frozen=True, slots=True)
class FileIntake:
    """Rows of one file, each once, and quarantine rows; each delivered row is stored, quarantined or a duplicate."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    n_delivered: int
    n_duplicate: int
    due_at: datetime | None = None
    """When the first row can be stored of those that were refused for a time after the clock's."""

    @property
    def n_quarantined(self) -> int:
        """Delivered rows behind the quarantine rows."""
        return int(self.quarantine["n_rows"].sum())

    @property
    def n_loaded(self) -> int:
        """Delivered rows stored."""
        return self.n_delivered - self.n_quarantined - self.n_duplicate

    @property
    def n_good(self) -> int:
        """Delivered rows that could be stored if there were no other delivery."""
        return self.n_loaded + self.n_duplicate + self.quarantine.filter(reason="conflicting_delivery").height
