"""The catalog's views as files to give away: Parquet, CSV, or a DuckDB file; a whole folder or none of it."""

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import duckdb
import polars as pl
import polars.selectors as cs
import pyarrow.parquet as pq

from pipelines.sharing.redaction import AccessScope, build
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.files import replacing_folder
from pipelines.storage.publication import views

FORMATS = ("parquet", "csv", "duckdb")
MANIFEST = "export.json"
_FORMULA = r"^\s*[=+\-@＝＋－＠]|^[\t\r\n]"
_BATCH_ROWS = 100_000
_TIME = "%Y-%m-%dT%H:%M:%S%.fZ"


def export(home: Path, folder: Path, sight: AccessScope, form: str, chosen: list[str] | None = None) -> dict[str, int]:
    """Write views (all by default) as files `<folder>/<view>.<form>`, or all of them as one `catalog.duckdb`.

    Returns
    -------
    dict
        Rows by view, which `<folder>/export.json` also says.

    Raises
    ------
    FileExistsError
        The folder holds what no export wrote.
    ValueError
        The folder lies in the home, whose tables are found by their names.
    """
    folder = folder.resolve()
    if folder.is_relative_to(home.resolve()):
        raise ValueError(f"{folder} lies in the home; name a folder outside of it")
    names = chosen or sorted(views())
    written = {MANIFEST, CATALOG, *(f"{v}.{f}" for v in views() for f in FORMATS)}
    with replacing_folder(folder, written) as temporary:
        with _window(home, sight, temporary / CATALOG if form == "duckdb" else None) as con:
            write = {"parquet": _parquet, "csv": _csv, "duckdb": _count}[form]
            rows = {view: write(con, view, temporary / f"{view}.{form}") for view in names}
        told = {"operator": sight.operator, "pseudonyms": sight.key is not None, "format": form, "rows": rows}
        (temporary / MANIFEST).write_text(json.dumps(told, indent=1) + "\n")
    return rows


@contextmanager
def _window(home: Path, sight: AccessScope, keep: Path | None) -> Iterator[duckdb.DuckDBPyConnection]:
    """The home's catalog where all may be seen; else, or to keep it, a database that holds nothing more."""
    if keep is None and sight.operator is None and sight.key is None:
        with connect(home) as con:
            yield con
        return
    with tempfile.TemporaryDirectory() as scratch, duckdb.connect(str(keep or Path(scratch, CATALOG))) as con:
        build(con, home, sight)
        yield con


def _batches(con: duckdb.DuckDBPyConnection, view: str) -> Iterator[pl.DataFrame]:
    """A view's rows, at least one frame; sums of counts as whole numbers and not as DuckDB's 128 bits."""
    answer = con.sql(f"select * from {view}").to_arrow_reader(_BATCH_ROWS)
    yield _plain(pl.DataFrame(pl.from_arrow(answer.schema.empty_table())))
    for batch in answer:
        yield _plain(pl.DataFrame(pl.from_arrow(batch)))


def _plain(frame: pl.DataFrame) -> pl.DataFrame:
    return frame.with_columns(cs.decimal().cast(pl.Int64))


def _parquet(con: duckdb.DuckDBPyConnection, view: str, path: Path) -> int:
    writer, n = None, 0
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
    """Text that a spreadsheet would take for a formula begins with an apostrophe; numbers stay numbers."""
    formula = cs.string().str.contains(_FORMULA)
    return frame.with_columns(pl.when(formula).then("'" + cs.string()).otherwise(cs.string()).name.keep())


def _count(con: duckdb.DuckDBPyConnection, view: str, _: Path) -> int:
    (n,) = con.execute(f"select count(*) from {view}").fetchone() or (0,)
    return int(n)
