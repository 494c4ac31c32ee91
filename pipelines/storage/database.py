"""Read and write small tables: in a SQLite file of the home or, where HDT_LEDGER_URL names one, in PostgreSQL.

SQLite itself creates two files beside one with a write-ahead log. A reader may have no right to write there, and a
read-only command must not, so a file is read without writing (`query_file`). A PostgreSQL database serves a fleet that
several machines work for; psycopg2 is imported with the first connection, and no message contains a password.
"""

import fcntl
import os
import socket
import sqlite3
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import quote, urlsplit

from hdt_core.loading import UserError
from pipelines.storage.files import make_private

URL = "HDT_LEDGER_URL"
_LOCK = "hashtext('hdt'), hashtext(current_schema())"
_TURN = "hashtext('hdt turn'), hashtext(current_schema())"
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


@contextmanager
def turn(path: Path, url: str, *, shared: bool) -> Iterator[None]:
    """Wait for a lock and hold it during the block, with others that share it or alone; on a file or in a database."""
    with ExitStack() as stack:
        if url:
            stack.enter_context(_one_line_errors(url))
            cursor = stack.enter_context(_connection(url)).cursor()
            cursor.execute(f"select pg_advisory_lock{'_shared' if shared else ''}({_TURN})")
        else:
            file = stack.enter_context(open(make_private(path), "rb"))
            fcntl.flock(file, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
        yield


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


_TRIES = 20
Result = TypeVar("Result")


@dataclass(frozen=True)
class Database:
    """Tables of one schema in SQLite or, where there is a `url`, in PostgreSQL.

    `schema` creates the tables of either; `sqlite_only` are statements that PostgreSQL does without.
    """

    path: Path
    url: str = field(repr=False)  # may name a password
    schema: str
    sqlite_only: tuple[str, ...] = ()
    journal: str = "wal"

    @contextmanager
    def transaction(self, first: str = "", *, write: bool = True) -> Iterator[Any]:
        """Open a transaction, committed unless the block raises; in SQLite one that writes excludes other writers.

        It begins with the statement `first`.
        """
        if self.url:
            with session(self.url, self.schema.replace(" without rowid", "")) as connection:
                if first:
                    connection.execute(first)
                yield connection
            return
        if not self.path.exists():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            make_private(self.path)
        with closing(sqlite3.connect(self.path, timeout=60, isolation_level=None)) as con:
            con.execute(f"pragma journal_mode={self.journal}")
            con.execute("pragma synchronous=full")
            con.execute("begin immediate" if write or not _has_tables(con) else "begin")
            with con:
                for statement in (*self.schema.split(";"), *self.sqlite_only, first):
                    con.execute(statement)
                yield con

    def query(self, query: Callable[[Any], Result]) -> Result:
        """Run a query without writing to a file; on empty tables where there are none yet."""
        if self.url:
            with self.transaction() as connection:
                return query(connection)
        if self.path.exists() and self.path.stat().st_size:  # empty: the first transaction was never committed
            results = query_file(self.path, lambda con: [query(con)] if _has_tables(con) else [])
            if results:
                return results[0]
        with closing(sqlite3.connect(":memory:")) as con:
            con.executescript(self.schema)
            return query(con)


def _has_tables(con: sqlite3.Connection) -> bool:
    return bool(con.execute("select count(*) from sqlite_master").fetchone()[0])  # one transaction makes all


def query_file(path: Path, query: Callable[[sqlite3.Connection], Result]) -> Result:
    """Run a query on the file.

    A log beside it means that a writer is at work or was killed: SQLite shares its files. Otherwise the file is opened
    as immutable, and again if it has changed meanwhile.
    """
    for _ in range(_TRIES):
        before = _stamp(path)
        if before[2]:
            break
        try:
            result = _run(path, "immutable=1", query)
        except sqlite3.DatabaseError:
            if _stamp(path) == before:
                raise
            continue
        if _stamp(path) == before:
            return result
    return _run(path, "mode=ro", query)


def query_value(path: Path, sql: str) -> str:
    """Run a statement that answers one value; the value or the error as text of one line."""
    try:
        return str(query_file(path, lambda con: con.execute(sql).fetchone()[0])).splitlines()[0]
    except sqlite3.DatabaseError as error:
        return str(error).splitlines()[0]


def _run(path: Path, mode: str, query: Callable[[sqlite3.Connection], Result]) -> Result:
    with closing(sqlite3.connect(f"file:{quote(str(path.resolve()))}?{mode}", uri=True, timeout=60)) as con:
        return query(con)


def _stamp(path: Path) -> tuple[int, int, bool]:
    """Return size and time, which change with every commit, and whether a writer's log is in use."""
    stat = path.stat()
    log = path.with_name(f"{path.name}-wal")
    try:
        log_in_use = log.stat().st_size > 0
    except FileNotFoundError:  # none, or its writer has just removed it
        log_in_use = False
    return stat.st_size, stat.st_mtime_ns, log_in_use
