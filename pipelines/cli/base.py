"""Shared by every command: consoles, the landing and home folders, and errors of one line.

Heavy imports wait until a command needs them, so that `--help` and an idle night are quick.
"""

import importlib.metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperGroup

from hdt_core.loading import UserError

ORDER = (
    "nightly", "backfill", "status", "explain", "close", "case", "serve", "report", "digest", "orders", "query",
    "terms", "export", "trial", "dossier", "recorder", "ui", "simulate", "doctor", "metrics", "docs", "tidy",
    "benchmark",
)  # fmt: skip


class ByUse(TyperGroup):
    """Lists the commands in the order of their use."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return names in the order of `ORDER`; commands of extensions that it does not list come last."""
        return sorted(self.commands, key=lambda name: (ORDER.index(name) if name in ORDER else len(ORDER), name))


app = typer.Typer(name="hdt", cls=ByUse, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
out = Console(highlight=False, markup=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, markup=False)


def _print_version(requested: bool) -> None:
    if requested:
        out.print(importlib.metadata.version("hybrid-digital-twin"))
        raise typer.Exit


@app.callback()
def command(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Hybrid digital twin: from recorder files to which heat exchanger to change, why, and when."""


LandingDir = Annotated[
    Path | None, typer.Option(envvar="HDT_LANDING", help="Folder the ground station drops files into.")
]
HomeDir = Annotated[
    Path | None, typer.Option(envvar="HDT_HOME", help="Folder that holds tables, catalog and run history.")
]
Language = Annotated[str | None, typer.Option(envvar="HDT_LANGUAGE", help="Language of the output: en, de.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]

UsageError: Any = typer.BadParameter.__base__  # of the click inside typer


class StopError(UserError):
    """Ends the command with one line on how to correct it."""


def print_error(message: str) -> None:
    """Print one line on standard error."""
    err.print(f"hdt: {message}", soft_wrap=True)


def landing_folder(path: Path | None) -> Path:
    """Return the landing zone; stop with a line on what is wrong with it."""
    from pipelines.orchestration.around_night import find_landing_fault

    landing = _required(path, "--landing", "HDT_LANDING")
    if fault := find_landing_fault(landing):
        raise StopError(fault)
    return landing


def home_folder(path: Path | None, *, must_exist: bool = True) -> Path:
    """Return the home; stop with a line on what is wrong with it."""
    home = _required(path, "--home", "HDT_HOME")
    if home.exists() and not home.is_dir():
        raise StopError(f"{home} is a file; give --home a folder")
    if must_exist and not (home / "catalog.duckdb").exists():
        raise StopError(f"no catalog in {home}; run `hdt nightly --landing DIR --home {home}` first")
    return home


def _required(path: Path | None, option: str, variable: str) -> Path:
    if path is None:
        raise StopError(f"name a folder with {option} DIR or set {variable}")
    return path
