"""Write the catalog's views as Parquet, CSV or one DuckDB file; a complete folder or none."""

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
        with connect(home) as con:
            yield con
        return
    with tempfile.TemporaryDirectory() as scratch, duckdb.connect(str(keep or Path(scratch, CATALOG))) as con:
        build(con, home, scope)
        yield con


def _batches(con: duckdb.DuckDBPyConnection, view: str) -> Iterator[pl.DataFrame]:
    """Yield a view's rows in at least one frame, with DuckDB's 128-bit sums of counts as integers."""
    reader = con.sql(f"select * from {view}").to_arrow_reader(_BATCH_ROWS)
    yield _plain(pl.DataFrame(pl.from_arrow(reader.schema.empty_table())))
    for batch in reader:
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
    """Write lists as text, and put an apostrophe before text that a spreadsheet would read as a formula."""
    frame = frame.with_columns(cs.list().cast(pl.List(pl.String)).list.join(" ", ignore_nulls=True))
    formula = cs.string().str.contains(_FORMULA)
    return frame.with_columns(pl.when(formula).then("'" + cs.string()).otherwise(cs.string()).name.keep())


def _count(con: duckdb.DuckDBPyConnection, view: str, _: Path) -> int:
    (n,) = con.execute(f"select count(*) from {view}").fetchone() or (0,)
    return int(n)
