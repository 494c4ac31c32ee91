"""Keep the ledger's tables in a PostgreSQL database, for a fleet that several machines work for; and lock them.

psycopg2 is imported with the first connection. No message here contains a password.
"""

import os
import socket
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any
from urllib.parse import urlsplit

from hdt_core.loading import UserError

URL = "HDT_LEDGER_URL"
_LOCK = "hashtext('hdt'), hashtext(current_schema())"
# the server detects after a minute that a machine has lost its power, and releases its lock
_KEEPALIVE = "set tcp_keepalives_idle = 30; set tcp_keepalives_interval = 10; set tcp_keepalives_count = 3"
_HOLDER = (
    "select application_name from pg_stat_activity join pg_locks using (pid) where locktype = 'advisory' and granted"
    " and database = (select oid from pg_database where datname = current_database())"
    " and classid::bigint = hashtext('hdt')::bigint & 4294967295"
    " and objid::bigint = hashtext(current_schema())::bigint & 4294967295"
)


class DatabaseError(UserError):
    """The ledger's database does not answer; the message names it and the remedy, in one line."""


class Session:
    """A transaction's connection with SQLite's interface: `?` marks an argument."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    def execute(self, sql: str, arguments: Iterable[Any] = ()) -> Any:
        """Run one statement; its cursor."""
        cursor = self._connection.cursor()
        cursor.execute(sql.replace("?", "%s"), tuple(arguments))
        return cursor

    def executemany(self, sql: str, rows: Iterable[tuple[Any, ...]]) -> None:
        """Run one statement for every row, a thousand a round trip."""
        from psycopg2.extras import execute_batch

        execute_batch(self._connection.cursor(), sql.replace("?", "%s"), rows, page_size=1000)


@contextmanager
def session(url: str, schema: str) -> Iterator[Session]:
    """Open a transaction, committed unless the block raises; `schema` makes the tables, once a process."""
    with _one_line_errors(url):
        _prepare(url, schema)
        with _connection(url) as connection, connection:
            yield Session(connection)


@contextmanager
def fleet_lock(url: str) -> Iterator[str | None]:
    """Lock the fleet for this process during the block; yields the holder where another process has the lock.

    The lock is released with the connection, however its process ends.
    """
    with _one_line_errors(url), ExitStack() as stack:
        connection = stack.enter_context(_connection(url))
        connection.autocommit = True
        holder = _acquire(connection.cursor())
        open_connection = stack.pop_all()
    with open_connection:
        yield holder


def _acquire(cursor: Any) -> str | None:
    """Acquire the lock; None, or its holder."""
    cursor.execute(_KEEPALIVE)
    cursor.execute(f"select pg_try_advisory_lock({_LOCK})")
    if cursor.fetchone()[0]:
        return None
    cursor.execute(_HOLDER)
    holder = cursor.fetchone()
    return (holder and holder[0]) or "someone unknown"


@contextmanager
def _connection(url: str) -> Iterator[Any]:
    import psycopg2

    name = f"process {os.getpid()} on {socket.gethostname()}"
    connection = psycopg2.connect(url, connect_timeout=10, application_name=name[:63])
    try:
        yield connection
    finally:
        connection.close()


@cache
def _prepare(url: str, schema: str) -> None:
    """Create the tables, one process at a time: two at once disturb each other."""
    with _connection(url) as connection, connection:
        cursor = connection.cursor()
        cursor.execute(f"select pg_advisory_xact_lock(hashtext('hdt tables'), hashtext(current_schema())); {schema}")


@contextmanager
def _one_line_errors(url: str) -> Iterator[None]:
    """Raise in one line that the database does not answer, or that its address is malformed."""
    try:
        import psycopg2
    except ImportError:
        raise DatabaseError(f"{URL} names a database; install the extra postgres") from None
    try:
        yield
    except psycopg2.ProgrammingError as error:
        if error.pgcode:  # a fault of ours, and no address
            raise
        raise DatabaseError(f"{URL} is no address of the form postgresql://user@host:5432/database") from None
    except (psycopg2.OperationalError, psycopg2.InterfaceError) as error:
        raise DatabaseError(
            f"the ledger's database at {_place(url)} ({URL}) does not answer: {_why(error, url)}"
        ) from None


def _place(url: str) -> str:
    """Host, port and database, without user and password."""
    parts = urlsplit(url)
    return f"{parts.netloc.rpartition('@')[2]}{parts.path}"


def _why(error: Exception, url: str) -> str:
    message = (str(error).strip() or type(error).__name__).splitlines()[0]
    secret = urlsplit(url).password
    return message.replace(secret, "***") if secret else message
