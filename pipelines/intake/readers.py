"""Find readers of files outside the contract: each package reads the folders that it names.

A package registers a reader by an entry point of the group `hdt.readers` that names a module with all of `Reader`.
"""

from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import polars as pl

from hdt_core.loading import UserError, load_entry_points
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import FileIntake, Kind, LandingFile

REPORTS, TYPES = "reports", "types"
"""Folder of an aircraft with printed reports; folder of the landing zone with descriptions of recordings."""
NO_READER = "hdt_recorder of the package hybrid-digital-twin-extensions reads it, which is not installed"
KindOf = Callable[[str], Kind | Fault]
Rows = tuple[pl.DataFrame, int, list[Fault]]
Writer = Callable[[pl.DataFrame, Path], None]


class Zone(Protocol):
    """A reader's view of a landing zone."""

    @property
    def faults(self) -> Mapping[str, str]:
        """Faults of descriptions in `types/`, by name of the file."""

    def kinds(self, operator: str, tail: str, folder: str) -> tuple[str, KindOf]:
        """Version of the description that files are read by, or empty; and the kind of a file by its name."""


@runtime_checkable
class Reader(Protocol):
    """Interface of a package's reader; a landing zone is a full path without links."""

    FOLDERS: tuple[str, ...]
    FORMATS: Mapping[str, tuple[str, ...]]
    """Formats of the files of each type of aircraft that it can simulate, the usual one first."""

    def open_zone(self, landing: Path) -> Zone:
        """Open the descriptions of a landing zone's files."""

    def components_in(self, file: LandingFile) -> tuple[str, ...]:
        """List the folders of the components that a recording describes."""

    def rows(self, file: LandingFile, table: str) -> Rows:
        """Read the rows of `pack` or of a component's code, their number, and the file's faults."""

    def read_printed(self, file: LandingFile, now: datetime, version: str) -> FileIntake:
        """Read the heads of a file's printed reports in the columns of `raw_reports`."""

    def coverage(self, landing: Path) -> pl.DataFrame:
        """List as `raw_coverage` what each aircraft's recordings lack."""

    def checks(self, landing: Path) -> Iterator[tuple[str, bool, str]]:
        """Yield lines of `hdt doctor`: name, whether it passed, message."""

    def install(self, landing: Path, suite: str, form: str) -> tuple[str, Writer]:
        """Describe a simulated type in a zone; its name there, and the writer of a flight's rows as a file."""


class ReaderError(UserError):
    """There is no reader, or a package's entry point is none."""


class Readers(dict[str, Reader]):
    """The reader of each folder."""

    def __missing__(self, folder: str) -> Reader:
        raise ReaderError(f"{folder}/: {NO_READER}")


@cache
def readers() -> Readers:
    """Load the packages' readers; a `ReaderError` names one that fails, is none, or reads another's folder."""
    by_folder = Readers()
    for entry_point, module in load_entry_points("hdt.readers", "reader", ReaderError):
        if not isinstance(module, Reader):
            raise ReaderError(f"{entry_point} is no Reader")
        if conflicts := sorted(by_folder.keys() & set(module.FOLDERS)):
            raise ReaderError(f"{entry_point}: there is a reader of {conflicts[0]}/ already")
        by_folder.update(dict.fromkeys(module.FOLDERS, module))
    return by_folder
