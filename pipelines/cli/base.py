"""Shared by every command: consoles, the landing and home folders, errors of one line, and stop signals.

Heavy imports wait until a command needs them, so that `--help` and an idle night are quick.
"""

import atexit
import codecs
import importlib.metadata
import io
import json
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
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


def escape_unencodable_output() -> None:
    """Print what a terminal's encoding lacks as JSON escapes it, and lines of tables as `+`, `-` and `|`."""
    codecs.register_error("hdt.escape", _escape)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="hdt.escape")


def _escape(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    return "".join(map(_in_ascii, error.object[error.start : error.end])), error.end


def _in_ascii(character: str) -> str:
    if "\u2500" <= character <= "\u257f":
        return {"\u2500": "-", "\u2502": "|"}.get(character, "+")
    return json.dumps(character).strip('"')


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
    from pipelines.orchestration.around_night import find_home_fault

    home = _required(path, "--home", "HDT_HOME")
    if fault := find_home_fault(home):
        raise StopError(fault)
    if home.exists() and not home.is_dir():
        raise StopError(f"{home} is a file; give --home a folder")
    if must_exist and not (home / "catalog.duckdb").exists():
        raise StopError(f"no catalog in {home}; run `hdt nightly --landing DIR --home {home}` first")
    return home


def _required(path: Path | None, option: str, variable: str) -> Path:
    if path is None:
        raise StopError(f"name a folder with {option} DIR or set {variable}")
    return path


STOPS = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S = 1.0


class StoppedError(BaseException):
    """A stop signal, outside `Exception` so that nothing handles it as an error; `code` is the exit code."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.code = 128 + number


@contextmanager
def stop_in_order() -> Iterator[None]:
    """Raise `StoppedError` on Ctrl-C and SIGTERM within the block, so that unfinished files are removed."""

    signals: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        raise StoppedError(number)

    try:
        with _handled(stop):
            yield
    except BaseException:
        if signals:  # an interrupted library raises an error of its own
            raise StoppedError(signals[0]) from None
        raise


@contextmanager
def stop_at_once(report: Callable[[], None]) -> Iterator[None]:
    """End this process and its workers on Ctrl-C and SIGTERM within the block, with exit code 130 or 143.

    Nothing is cleaned up: a night may be killed at any moment. A thread ends the process, because Dagster installs
    handlers that drop signals between two steps, and Python runs none before a computation in C returns.
    """
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    previous = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)  # the handler in C writes to it at once
    watcher = threading.Thread(target=_watch, args=(reader, report), daemon=True)
    watcher.start()
    try:
        with _handled(lambda number, frame: None):
            yield
    finally:
        signal.set_wakeup_fd(previous)
        os.close(writer)
        watcher.join()
        os.close(reader)


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], None]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in STOPS}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _watch(reader: int, report: Callable[[], None]) -> None:
    while number := os.read(reader, 1):
        if number[0] in STOPS:
            _end(128 + number[0], report)


def _end(code: int, report: Callable[[], None]) -> None:
    """End workers and process; exit handlers release the workers' semaphores, else their tracker warns."""
    threading.Timer(_PATIENCE_S, os._exit, (code,)).start()
    try:
        for worker in multiprocessing.active_children():
            worker.kill()
        report()
        atexit._run_exitfuncs()
    finally:
        os._exit(code)
