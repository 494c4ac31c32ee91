"""The ledger's tables in a PostgreSQL database, for a fleet that several machines work for; and its lock.

Heavy only where it is used: psycopg2 is loaded with the first connection. Nothing said here names a password.
"""

import os
import socket
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from typing import Any
from urllib.parse import urlsplit

URL = "HDT_LEDGER_URL"
_LOCK = "hashtext('hdt'), hashtext(current_schema())"
# a machine that loses its power says no goodbye: the server finds out after a minute and frees its lock
_KEEPALIVE = "set tcp_keepalives_idle = 30; set tcp_keepalives_interval = 10; set tcp_keepalives_count = 3"
_HOLDER = (
    "select application_name from pg_stat_activity join pg_locks using (pid) where locktype = 'advisory' and granted"
    " and database = (select oid from pg_database where datname = current_database())"
    " and classid::bigint = hashtext('hdt')::bigint & 4294967295"
    " and objid::bigint = hashtext(current_schema())::bigint & 4294967295"
)


class DatabaseError(Exception):
    """The ledger's database does not answer; says which and what to do, in one line."""


class Session:
    """A transaction's connection, asked in the words SQLite is asked in: `?` stands for an argument."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection

    def execute(self, sql: str, arguments: Iterable[Any] = ()) -> Any:
        """Cursor of one statement."""
        cursor = self._connection.cursor()
        cursor.execute(sql.replace("?", "%s"), tuple(arguments))
        return cursor

    def executemany(self, sql: str, rows: Iterable[tuple[Any, ...]]) -> None:
        """One statement for every row, a thousand a round trip."""
        from psycopg2.extras import execute_batch

        execute_batch(self._connection.cursor(), sql.replace("?", "%s"), rows, page_size=1000)


@contextmanager
def session(url: str, schema: str) -> Iterator[Session]:
    """A transaction, committed if the block ends well; `schema` makes the tables, once a process."""
    with _answering(url):
        _prepare(url, schema)
        with _connected(url) as connection, connection:
            yield Session(connection)


@contextmanager
def locked(url: str) -> Iterator[str | None]:
    """Be the only one of all machines while the block runs; yields who is it instead, where someone is.

    The lock goes with the connection, however its process ends.
    """
    with _answering(url), ExitStack() as stack:
        connection = stack.enter_context(_connected(url))
        connection.autocommit = True
        holder = _take(connection.cursor())
        kept = stack.pop_all()
    with kept:
        yield holder


def _take(cursor: Any) -> str | None:
    """Take the lock; None, or who has it."""
    cursor.execute(_KEEPALIVE)
    cursor.execute(f"select pg_try_advisory_lock({_LOCK})")
    if cursor.fetchone()[0]:
        return None
    cursor.execute(_HOLDER)
    found = cursor.fetchone()
    return (found and found[0]) or "someone unknown"


@contextmanager
def _connected(url: str) -> Iterator[Any]:
    import psycopg2

    name = f"process {os.getpid()} on {socket.gethostname()}"
    connection = psycopg2.connect(url, connect_timeout=10, application_name=name[:63])
    try:
        yield connection
    finally:
        connection.close()


@cache
def _prepare(url: str, schema: str) -> None:
    """One process at a time: two that create the same table at once disturb each other."""
    with _connected(url) as connection, connection:
        cursor = connection.cursor()
        cursor.execute(f"select pg_advisory_xact_lock(hashtext('hdt tables'), hashtext(current_schema())); {schema}")


@contextmanager
def _answering(url: str) -> Iterator[None]:
    """Say in one line that the database does not answer, or that its address cannot be read."""
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
    """Host, port and database, without who asks."""
    parts = urlsplit(url)
    return f"{parts.netloc.rpartition('@')[2]}{parts.path}"


def _why(error: Exception, url: str) -> str:
    said = (str(error).strip() or type(error).__name__).splitlines()[0]
    secret = urlsplit(url).password
    return said.replace(secret, "***") if secret else said
