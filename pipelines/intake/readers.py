"""Who reads what is no file of the contract: packages that know recorders, each by the folders that it names.

A package brings a reader by an entry point of the group `hdt.readers` that names a module with all that `Reader` has.
"""

from collections.abc import Callable, Iterator, Mapping
from datetime import datetime
from functools import cache
from pathlib import Path
from typing import Protocol, runtime_checkable

import polars as pl

from hdt_core.packages import brought
from pipelines.intake.landing_file import Kind, LandingFile
from pipelines.intake.ledger import Fault
from pipelines.intake.log_lines import Log

REPORTS, TYPES = "reports", "types"
"""Folder of an aircraft that holds printed reports; folder of the landing zone that holds what describes recordings."""
ABSENT = "hdt_recorder of the package hybrid-digital-twin-extensions reads it, which is not installed"
Judge = Callable[[str], Kind | Fault]
Rows = tuple[pl.DataFrame, int, list[Fault]]
Writer = Callable[[pl.DataFrame, Path], None]


class Zone(Protocol):
    """What a reader knows of a landing zone."""

    @property
    def faults(self) -> Mapping[str, str]:
        """Why descriptions in `types/` can't be used, by name of the file."""

    def judge(self, operator: str, tail: str, folder: str) -> tuple[str, Judge]:
        """What else files are judged by, a hash or empty; and how each by its name, empty where it is no file."""


@runtime_checkable
class Reader(Protocol):
    """What the house asks about the folders that a package reads; a landing zone is a full path without links."""

    FOLDERS: tuple[str, ...]
    FORMATS: Mapping[str, tuple[str, ...]]
    """Of each type of aircraft that it can simulate the formats of its files, first the usual one."""

    def open_zone(self, landing: Path) -> Zone:
        """What describes the files of a landing zone."""

    def components_in(self, file: LandingFile) -> tuple[str, ...]:
        """Folders of the components that a recording describes."""

    def rows(self, file: LandingFile, table: str) -> Rows:
        """Rows of `pack` or a component's code in the columns of its files, how many, what is wrong with the file."""

    def read_printed(self, file: LandingFile, now: datetime, version: str) -> Log:
        """Heads of a file's printed reports in the columns of `raw_reports`."""

    def coverage(self, landing: Path) -> pl.DataFrame:
        """`raw_coverage`: what recordings of each aircraft can't tell."""

    def checks(self, landing: Path) -> Iterator[tuple[str, bool, str]]:
        """Lines of `hdt doctor`: name, whether it is well, what is said."""

    def install(self, landing: Path, suite: str, form: str) -> tuple[str, Writer]:
        """Describe a simulated type in a zone: its name there, and what writes a flight's rows as a file."""


class ReaderError(Exception):
    """There is no reader, or what a package brings is none."""


class Readers(dict[str, Reader]):
    """The reader of each folder."""

    def __missing__(self, folder: str) -> Reader:
        raise ReaderError(f"{folder}/: {ABSENT}")


@cache
def readers() -> Readers:
    """Those that packages bring; a `ReaderError` names one that fails, is none, or reads what another does."""
    known = Readers()
    for named, found in brought("hdt.readers", "reader", ReaderError):
        if not isinstance(found, Reader):
            raise ReaderError(f"{named} is no Reader")
        if taken := sorted(known.keys() & set(found.FOLDERS)):
            raise ReaderError(f"{named}: there is a reader of {taken[0]}/ already")
        known.update(dict.fromkeys(found.FOLDERS, found))
    return known
