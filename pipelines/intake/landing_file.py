"""Describe one file of the landing zone: its aircraft, its kind, what determines how it is read, what it holds."""

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Literal

import polars as pl

from pipelines.intake.faults import Fault, quarantine
from pipelines.intake.fields import flight_of_file
from pipelines.intake.lists import PACKS

Kind = Literal[
    "acms", "history", "cpl", "component", "recorder", "reports", "type", "messages", "maintenance", "fleet", "checks"
]
RECORDER = "recorder"
"""Folder of an aircraft that holds recordings."""
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

    @property
    def packs(self) -> int:
        """Packs of its aircraft."""
        return max(self.packs_listed, self.packs_stored)

    @property
    def packs_listed(self) -> int:
        """Packs by the fleet list; two where it names none."""
        return int(self._word("packs") or PACKS)

    @property
    def delivered_on(self) -> date | None:
        """Day on which its aircraft was delivered, of a maintenance log."""
        day = self._word("delivered_on")
        return date.fromisoformat(day) if day else None

    @property
    def other_operators(self) -> str | None:
        """None where the fleet list has the aircraft; else operators under which it has the tail."""
        return self._word("unlisted")

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
        return content, []

    @property
    def received_at(self) -> datetime:
        """When it was last written."""
        return modified_at(self.mtime_ns)


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
