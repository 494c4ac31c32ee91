"""The `hdt` command, a room for each of its users."""

import logging
import sqlite3
import sys

from hdt_core.packages import brought
from pipelines.cli import cases, digest, look, make, night, serve, share
from pipelines.cli.base import StopError, UsageError, app, out, say_error
from pipelines.cli.stops import StoppedError, ends_in_order

__all__ = ["app", "cases", "digest", "look", "main", "make", "night", "serve", "share"]


def main() -> None:
    """Run the command; whatever a user can mend is said in one line."""
    code = 2
    logging.captureWarnings(True)  # a library's warnings are no words for whoever reads the terminal
    _load_schemas()
    try:
        load_extensions()
        with ends_in_order():
            sys.exit(app(standalone_mode=False))
    except StopError as error:
        said = str(error)
    except UsageError as error:
        command = error.ctx.command_path if error.ctx else "hdt"
        if "Usage:" in error.format_message():  # no command given: the help itself
            out.print(error.format_message(), markup=False)
            sys.exit(2)
        said = f"{error.format_message()} `{command} --help` lists what it takes."
    except StoppedError as stop:
        said, code = "stopped", stop.code
    except OSError as error:
        said = f"{error.strerror or error}: {error.filename}" if error.filename else str(error)
    except Exception as error:
        said = _of_a_night(error)
    say_error(said)
    sys.exit(code)


def load_extensions() -> None:
    """Import the module of every entry point of the group `hdt.commands`, which adds its commands to `base.app`."""
    list(brought("hdt.commands", "commands", StopError))


def _load_schemas() -> None:
    """Load dataframely without SQLAlchemy, which it takes along where it finds it: a fifth of a command's start.

    No schema here is a database's; Dagster loads SQLAlchemy where there is something to run.
    """
    sys.modules.setdefault("sqlalchemy", None)  # type: ignore[arg-type]
    import dataframely  # noqa: F401

    if sys.modules["sqlalchemy"] is None:
        del sys.modules["sqlalchemy"]


def _of_a_night(error: Exception) -> str:
    """What a night can't do, in its own words; any other error goes on its way."""
    from hdt_core.components import ComponentError

    if isinstance(error, ComponentError):
        return f"{error}; mend or uninstall it"
    from pipelines.digest import NotifyError
    from pipelines.intake.readers import ReaderError
    from pipelines.orchestration.around_night import BusyError
    from pipelines.orchestration.local_executor import EngineError
    from pipelines.storage.postgres import DatabaseError

    ours = BusyError | DatabaseError | EngineError | NotifyError | ReaderError
    return str(error) if isinstance(error, ours) else _of_the_disk(error)


def _of_the_disk(error: Exception) -> str:
    """What SQLite says of a full or read-only disk, Dagster's storage included; any other error goes on its way."""
    cause = getattr(error, "orig", error)
    if isinstance(cause, sqlite3.DatabaseError) and any(word in str(cause) for word in _DAMAGED):
        what = "the ledger is damaged (%s); `hdt nightly`" if cause is error else "Dagster's history (%s); `hdt tidy`"
        return f"{what % cause} mends it, `hdt doctor` says more"
    if isinstance(cause, sqlite3.OperationalError):
        return f"{cause}; make room in the home or leave to write there, the next run goes on from here"
    return _of_the_database(error)


_DAMAGED = ("malformed", "not a database", "no such table", "no such column")


def _of_the_database(error: BaseException) -> str:
    """What PostgreSQL's client says when the database of Dagster's history does not answer: never a password."""
    seen: BaseException | None = error
    while seen is not None:
        cause = getattr(seen, "orig", None) or seen
        if type(cause).__module__ == "psycopg2" and type(cause).__name__ == "OperationalError":
            return f"the database of Dagster's history (dagster.yaml) does not answer: {str(cause).splitlines()[0]}"
        seen = seen.__cause__ or seen.__context__
    raise error
