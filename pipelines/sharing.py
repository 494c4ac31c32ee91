"""Write the catalog's views as Parquet, CSV or one DuckDB file: all, or one operator's rows, or under pseudonyms.

A catalog for one reader has `tables` with rows instead of views over files, so the file can be shared; its views are
the catalog's own, so a fleet median is that of the rows it holds. Rows without an operator (the fleet list's faults,
design parameters of the whole fleet) and the models, which are fitted to all operators' flights, are left out.
"""

import base64
import hashlib
import hmac
import json
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import duckdb
import polars as pl
import polars.selectors as cs
import pyarrow.parquet as pq

from pipelines.storage.catalog import CATALOG, connect, open_database
from pipelines.storage.catalog_views import STORED, add_meanings, add_named_views, fill_stored
from pipelines.storage.files import replacing_folder
from pipelines.storage.naming import Name, names_in
from pipelines.storage.ownership import names_of, select_rows
from pipelines.storage.view_headers import tables_read, views

FORMATS = ("parquet", "csv", "duckdb")
MANIFEST = "export.json"
_FORMULA = r"^\s*[=+\-@＝＋－＠]|^[\t\r\n]"
_BATCH_ROWS = 100_000
_TIME = "%Y-%m-%dT%H:%M:%S%.fZ"
WITHHELD = "[withheld]"
_TAILS = ("tail",)
_FLIGHTS = ("flight_id", "raised_flight_id", "now_flight_id", "first_flight_id", "end_flight_id")
_ALERT_IDS = ("alert_id", "case_id", "known_as", "follows", "closes_alert_id")
_IDENTITIES = (*_ALERT_IDS, "reference", "msn", "file", "serial_off", "serial_on")
"""Replaced by a keyed hash: names of parts, documents and files, each of which identifies an aircraft."""
_VERBATIM = ("detail", "content", "delivered_on", "origin", "destination", "person", "assignee", "note")
"""Left out under pseudonyms: contents of a rejected file; an aircraft's day of delivery; its route; the people and
notes of a case."""
_CODES = (
    "operator", "scope", "component", "parameter", "unit", "signal", "kind", "estimator", "source", "phase",
    "phase_code", "reason", "severity", "raised_severity", "severity_then", "urgency", "diagnosis", "action", "finding",
    "ended_by", "closed_reason", "split", "dsm_version", "model_version",
)  # fmt: skip
"""Text columns of the project's own codes. All others are searched for tails."""
_OF_NO_AIRCRAFT = {"components"}
"""Tables that hold declarations and no operator's rows. Any other without an operator is refused."""
_STAYS_HOME = {"raw_costs"}
"""Tables of which an operator gets no row: the owner's costs."""
KEY_BYTES = 16


@dataclass(frozen=True)
class AccessScope:
    """Rows a reader gets: of one operator or, with None, of all; under pseudonyms where there is a key.

    `own` are the tails that text may name, `foreign` the tails and `others` the operators that it may not.
    """

    operator: str | None
    key: bytes | None
    own: frozenset[str]
    foreign: frozenset[str]
    others: frozenset[str]

    def pseudonym(self, name: str, length: int = 9) -> str:
        """Return the pseudonym of `name` under the key, in the form of a tail: P and letters or digits 2 to 7.

        45 bits at the default length: two of 10,000 aircraft share a pseudonym once in a million keys.
        """
        if self.key is None:
            raise ValueError("a pseudonym needs a key")
        digest = hmac.new(self.key, name.encode(), hashlib.sha256).digest()
        return "P" + base64.b32encode(digest).decode()[:length]

    def redact(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return `frame` with names replaced and free text searched for tails."""
        if self.key is not None:
            frame = frame.with_columns(pl.lit(None, frame.schema[c]).alias(c) for c in _VERBATIM if c in frame.columns)
            for columns, rename in ((_TAILS, self.pseudonym), (_FLIGHTS, self._flight), (_IDENTITIES, self._identity)):
                frame = frame.with_columns(_rename_distinct(frame[c], rename) for c in columns if c in frame.columns)
        identities = _IDENTITIES if self.key is not None else _ALERT_IDS
        exempt = {*_TAILS, *_FLIGHTS, *_CODES, *identities}
        texts = [c for c, t in frame.schema.items() if t == pl.String and c not in exempt and not c.endswith("_status")]
        return frame.with_columns(self._redact_text(pl.col(c)) for c in texts) if texts else frame

    def redact_name(self, name: Name) -> Name:
        """Return the name that a renamed airframe has in the reader's rows."""
        if self.key is None:
            return name
        key, present, delivered = (
            (operator, self.pseudonym(tail)) for operator, tail in (name.key, name.present, name.delivered)
        )
        return Name(key, present, self.pseudonym(name.flight_tail), delivered)

    def _flight(self, flight_id: str) -> str:
        parts = re.fullmatch(r"(.+)(_\d{8}_\d{2})", flight_id)
        return self.pseudonym(parts[1]) + parts[2] if parts else self._identity(flight_id)

    def _identity(self, name: str) -> str:
        return self.pseudonym(name, 19)

    def _redact_text(self, text: pl.Expr) -> pl.Expr:
        """Replace the tails in a text, in any spelling; the longest match counts."""
        to_text = {t: t if self.key is None else self.pseudonym(t) for t in self.own} | dict.fromkeys(
            self.foreign, WITHHELD
        )
        to_text |= {t.replace("-", ""): name for t, name in to_text.items()}
        tails = sorted(to_text, key=lambda t: (-len(t), t))
        text = text.str.replace_many(tails, [to_text[t] for t in tails], ascii_case_insensitive=True, leftmost=True)
        others = rf"\b({'|'.join(sorted(self.others))})\b"
        return text.str.replace_all(others, WITHHELD) if self.others else text


def _rename_distinct(column: pl.Series, rename: Callable[[str], str]) -> pl.Series:
    """Rename each distinct name once; null stays null."""
    names = column.drop_nulls().unique()
    return column.replace_strict(names, pl.Series([rename(n) for n in names], dtype=pl.String), default=None)


def access_scope(home: Path, operator: str | None, key: bytes | None) -> AccessScope:
    """Return the rows of a home that an operator gets.

    Raises
    ------
    ValueError
        The home has no such operator, or the key is short enough to be guessed.
    """
    if key is not None and len(key) < KEY_BYTES:
        raise ValueError(
            f"the key has fewer than {KEY_BYTES} bytes and could be guessed; `openssl rand -hex 32` makes one"
        )
    aircraft = _aircraft(home)
    if operator is not None and operator not in {o for o, _ in aircraft}:
        operators = ", ".join(sorted({o for o, _ in aircraft})) or "none yet"
        raise ValueError(f"no operator {operator} in {home}; it holds {operators}")
    own = frozenset(t for o, t in aircraft if operator in (None, o))
    others = frozenset(o for o, _ in aircraft if operator not in (None, o))
    return AccessScope(operator, key, own, frozenset(t for _, t in aircraft) - own, others)


def _aircraft(home: Path) -> set[tuple[str, str]]:
    """List every aircraft in the home: on the fleet list, among the flights, among the rejected files."""
    with connect(home) as con:
        queries = [
            f"select operator, tail from tables.{t}"
            for t in tables_read()
            if t.startswith("raw_") and t not in _STAYS_HOME
        ]
        queries.append("select operator, tail from tables.names")
        return {(o, t) for o, t in con.execute(" union ".join(queries)).fetchall() if o and t}


def build(con: duckdb.DuckDBPyConnection, home: Path, scope: AccessScope) -> None:
    """Fill an empty database with the scope's rows, table by table and batch by batch, and the catalog's views."""
    con.execute("set TimeZone = 'UTC'")
    con.begin()
    con.execute("create schema tables")
    with connect(home) as source:
        names = names_in(source)
        for table in tables_read():
            _copy(source, con, table, scope, names)
            add_meanings(con, table)
    own_names = names if scope.operator is None else names_of(scope.operator, names)
    add_named_views(con, [scope.redact_name(name) for name in own_names], STORED)
    fill_stored(con)
    con.commit()


def _copy(
    source: duckdb.DuckDBPyConnection, con: duckdb.DuckDBPyConnection, table: str, scope: AccessScope,
    names: list[Name],
) -> None:  # fmt: skip
    everything = source.sql(f"select * from tables.{table}")
    rows = everything
    if scope.operator is not None and table in _STAYS_HOME:
        rows = everything.limit(0)
    elif scope.operator is not None and table not in _OF_NO_AIRCRAFT:
        rows = source.sql(select_rows(table, everything.columns, scope.operator, names))
    columns = ", ".join(f'"{n}" {t}' for n, t in zip(everything.columns, everything.types, strict=True))
    con.execute(f"create table tables.{table} ({columns})")
    for batch in rows.to_arrow_reader(_BATCH_ROWS):
        con.register("frame", scope.redact(pl.DataFrame(pl.from_arrow(batch))))
        con.execute(f"insert into tables.{table} by name select * from frame")
        con.unregister("frame")


def export(home: Path, folder: Path, scope: AccessScope, form: str, names: list[str] | None = None) -> dict[str, int]:
    """Write views (all by default) as files `<folder>/<view>.<form>`, or all of them as one `catalog.duckdb`.

    Returns
    -------
    dict
        Rows by view, as in `<folder>/export.json`.

    Raises
    ------
    FileExistsError
        The folder holds files that no export wrote.
    ValueError
        The folder lies in the home, whose tables are identified by their paths.
    """
    folder = folder.resolve()
    if folder.is_relative_to(home.resolve()):
        raise ValueError(f"{folder} lies in the home; name a folder outside of it")
    names = names or sorted(views())
    own_files = {MANIFEST, CATALOG, *(f"{v}.{f}" for v in views() for f in FORMATS)}
    with replacing_folder(folder, own_files) as temporary:
        with _window(home, scope, temporary / CATALOG if form == "duckdb" else None) as con:
            write = {"parquet": _parquet, "csv": _csv, "duckdb": _count}[form]
            rows = {view: write(con, view, temporary / f"{view}.{form}") for view in names}
        manifest = {"operator": scope.operator, "pseudonyms": scope.key is not None, "format": form, "rows": rows}
        (temporary / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return rows


@contextmanager
def _window(home: Path, scope: AccessScope, keep: Path | None) -> Iterator[duckdb.DuckDBPyConnection]:
    """Open the home's catalog for an unlimited scope; else, or to write to `keep`, a database of the scope's rows."""
    if keep is None and scope.operator is None and scope.key is None:
        with connect(home, as_delivered=True) as con:
            yield con
        return
    with tempfile.TemporaryDirectory() as scratch, open_database(keep or Path(scratch, CATALOG)) as con:
        build(con, home, scope)
        yield con


def _batches(con: duckdb.DuckDBPyConnection, view: str) -> Iterator[pl.DataFrame]:
    """Yield a view's rows in at least one frame."""
    reader = con.sql(f"select * from {view}").to_arrow_reader(_BATCH_ROWS)
    yield pl.DataFrame(pl.from_arrow(reader.schema.empty_table()))
    for batch in reader:
        yield pl.DataFrame(pl.from_arrow(batch))


def _parquet(con: duckdb.DuckDBPyConnection, view: str, path: Path) -> int:
    writer = None
    n = 0
    for frame in _batches(con, view):
        table = frame.to_arrow(compat_level=pl.CompatLevel.oldest())
        writer = writer or pq.ParquetWriter(path, table.schema, compression="zstd")
        writer.write_table(table)
        n += frame.height
    if writer:
        writer.close()
    return n


def _csv(con: duckdb.DuckDBPyConnection, view: str, path: Path) -> int:
    n = 0
    with open(path, "wb") as sink:
        for k, frame in enumerate(_batches(con, view)):
            safe(frame).write_csv(sink, include_header=k == 0, datetime_format=_TIME, quote_style="non_numeric")
            n += frame.height
    return n


def safe(frame: pl.DataFrame) -> pl.DataFrame:
    """Write lists as text, and put an apostrophe before text that a spreadsheet would read as a formula."""
    frame = frame.with_columns(cs.list().cast(pl.List(pl.String)).list.join(" ", ignore_nulls=True))
    formula = cs.string().str.contains(_FORMULA)
    return frame.with_columns(pl.when(formula).then("'" + cs.string()).otherwise(cs.string()).name.keep())


def _count(con: duckdb.DuckDBPyConnection, view: str, _: Path) -> int:
    (n,) = con.execute(f"select count(*) from {view}").fetchone() or (0,)
    return int(n)
