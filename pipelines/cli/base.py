"""What every command shares: consoles, the two folders, and an error that is one line.

Heavy imports wait until a command needs them, so that `--help` and an idle night are quick.
"""

import importlib.metadata
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

ORDER = (
    "nightly", "backfill", "status", "explain", "close", "case", "serve", "report", "digest", "orders", "query",
    "terms", "export", "trial", "dossier", "recorder", "ui", "simulate", "doctor", "docs", "tidy", "benchmark",
)  # fmt: skip


class ByUse(TyperGroup):
    """Lists the commands in the order in which they are met."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names as `--help` and completion show them; those of an extension that `ORDER` does not list come last."""
        return sorted(self.commands, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))


app = typer.Typer(name="hdt", cls=ByUse, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
out, err = Console(highlight=False), Console(stderr=True, highlight=False)


def _say_version(asked: bool) -> None:
    if asked:
        out.print(importlib.metadata.version("hybrid-digital-twin"))
        raise typer.Exit


@app.callback()
def command(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Say the version and exit.")
    ] = False,
) -> None:
    """Hybrid digital twin: from recorder files to which heat exchanger to change, why, and when."""


LandingDir = Annotated[
    Path | None, typer.Option(envvar="HDT_LANDING", help="Folder the ground station drops files into.")
]
HomeDir = Annotated[
    Path | None, typer.Option(envvar="HDT_HOME", help="Folder that holds tables, catalog and run history.")
]
Language = Annotated[str | None, typer.Option(envvar="HDT_LANGUAGE", help="Language to speak: en, de.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]

UsageError: Any = typer.BadParameter.__base__  # of the click that typer carries


class StopError(Exception):
    """Ends the command with one line that says what to do."""


@contextmanager
def spoken(language: str | None) -> Iterator[None]:
    """Speak a language, or end with a line that lists them."""
    from pipelines.words import NoLanguageError, speaking

    try:
        with speaking(language):
            yield
    except NoLanguageError as error:
        raise StopError(str(error)) from None


def say_error(words: str) -> None:
    """One line on standard error."""
    err.print(f"hdt: {words}", markup=False, soft_wrap=True)


def landing_folder(path: Path | None) -> Path:
    """The landing zone, or a line that says what is wrong with it."""
    from pipelines.zone import fault_of

    landing = _named(path, "--landing", "HDT_LANDING")
    if fault := fault_of(landing):
        raise StopError(fault)
    return landing


def home_folder(path: Path | None, *, must_exist: bool = True) -> Path:
    """The home, or a line that says what is wrong with it."""
    home = _named(path, "--home", "HDT_HOME")
    if home.exists() and not home.is_dir():
        raise StopError(f"{home} is a file; give --home a folder")
    if must_exist and not (home / "catalog.duckdb").exists():
        raise StopError(f"no catalog in {home}; run `hdt nightly --landing DIR --home {home}` first")
    return home


def _named(path: Path | None, option: str, variable: str) -> Path:
    if path is None:
        raise StopError(f"name a folder with {option} DIR or set {variable}")
    return path
