"""The `hdt` command, a module for each group of its users."""

import errno
import logging
import os
import sqlite3
import sys

from hdt_core.loading import UserError, load_entry_points
from pipelines.cli import cases, look, make, night, serve, share
from pipelines.cli.base import (
    StopError,
    StoppedError,
    UsageError,
    app,
    escape_unencodable_output,
    out,
    print_error,
    stop_in_order,
)

__all__ = ["app", "cases", "look", "main", "make", "night", "serve", "share"]


def main() -> None:
    """Run the command; print an error that a user can correct as one line."""
    logging.captureWarnings(True)  # warnings of libraries do not concern the reader of the terminal
    escape_unencodable_output()
    _load_schemas()
    try:
        load_extensions()
        with stop_in_order():
            sys.exit(app(standalone_mode=False))
    except UserError as error:
        message = str(error)
    except UsageError as error:
        command = error.ctx.command_path if error.ctx else "hdt"
        if "Usage:" in error.format_message():  # without a command: the help itself
            out.print(error.format_message())
            sys.exit(2)
        message = f"{error.format_message()} `{command} --help` lists its arguments and options."
    except StoppedError as stop:
        print_error("stopped")
        sys.stdout.flush()
        os._exit(stop.code)  # all is unwound; of what a server's thread still holds, DuckDB would print a page
    except OSError as error:
        message = f"{error.strerror or error}: {error.filename}" if error.filename else str(error)
    except Exception as error:
        message = _storage_error(error)
    print_error(message)
    sys.exit(2)


def load_extensions() -> None:
    """Import the module of every entry point of the group `hdt.commands`, which adds its commands to `base.app`."""
    list(load_entry_points("hdt.commands", "commands", StopError))


def _load_schemas() -> None:
    """Load dataframely without SQLAlchemy, which it imports where it is installed: a fifth of a command's start.

    No schema here is of a database; Dagster imports SQLAlchemy once there is something to run.
    """
    sys.modules.setdefault("sqlalchemy", None)  # type: ignore[arg-type]
    import dataframely  # noqa: F401

    if sys.modules["sqlalchemy"] is None:
        del sys.modules["sqlalchemy"]


def _storage_error(error: Exception) -> str:
    """Return the message for an old catalog, a damaged SQLite file, a full or read-only disk; raise any other error."""
    import duckdb

    if isinstance(error, duckdb.Error) and any(reason in str(error) for reason in _FILE_ERRORS):
        return f"{str(error).splitlines()[0]}; free space or grant write access"
    if isinstance(error, duckdb.CatalogException | duckdb.BinderException):
        return "an earlier version wrote the catalog; `hdt nightly` writes it again"
    cause = getattr(error, "orig", error)
    if isinstance(cause, sqlite3.DatabaseError) and any(word in str(cause) for word in _DAMAGED):
        file = "the ledger is damaged (%s); `hdt nightly`" if cause is error else "Dagster's history (%s); `hdt tidy`"
        return f"{file % cause} repairs it, `hdt doctor` shows details"
    if isinstance(cause, sqlite3.OperationalError):
        return f"{cause}; free space in the home or grant write access, the next run continues from here"
    return _postgres_error(error)


_FILE_ERRORS = [os.strerror(n) for n in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS, errno.EACCES)]
_DAMAGED = ("malformed", "not a database", "no such table", "no such column")


def _postgres_error(error: BaseException) -> str:
    """Return the first line, which holds no password, where the database of Dagster's history fails; raise others."""
    link: BaseException | None = error
    while link is not None:
        cause = getattr(link, "orig", None) or link
        if type(cause).__module__ == "psycopg2" and type(cause).__name__ == "OperationalError":
            return f"the database of Dagster's history (dagster.yaml) does not answer: {str(cause).splitlines()[0]}"
        link = link.__cause__ or link.__context__
    raise error
