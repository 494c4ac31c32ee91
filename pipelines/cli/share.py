"""The command that copies the catalog's views for others: export."""

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from pipelines.cli.base import HomeDir, StopError, app, home_folder, out

KEY = "HDT_EXPORT_KEY"


class Format(StrEnum):
    """File formats of an export."""

    parquet = "parquet"
    csv = "csv"
    duckdb = "duckdb"


@app.command()
def export(
    target: Annotated[Path, typer.Option("--out", help="Folder to write: a new one, or an earlier export's.")],
    home: HomeDir = None,
    operator: Annotated[str | None, typer.Option(help="Only rows of this operator.")] = None,
    view: Annotated[list[str] | None, typer.Option(help="Only this view; may be given more than once.")] = None,
    form: Annotated[Format, typer.Option("--format", help="Files of views, or one catalog.")] = Format.parquet,
    pseudonymise: Annotated[
        bool,
        typer.Option("--pseudonymise", help="Replace tails, serial numbers and document references by a keyed hash."),
    ] = False,
    key_file: Annotated[Path | None, typer.Option(help=f"File with the key; default: variable {KEY}.")] = None,
) -> None:
    """Write the catalog's views as Parquet, CSV or DuckDB."""
    from pipelines.sharing import access_scope
    from pipelines.sharing import export as write
    from pipelines.storage.publication import views

    where, names = home_folder(home), views()
    if unknown_views := [v for v in view or () if v not in names]:
        raise StopError(f"no view {unknown_views[0]}; the catalog has {', '.join(sorted(names))}")
    if view and form == Format.duckdb:
        raise StopError("a DuckDB file holds every view; leave --view out")
    if key_file and not pseudonymise:
        raise StopError("a key is for --pseudonymise; give both or neither")
    try:
        rows = write(where, target, access_scope(where, operator, _key(key_file) if pseudonymise else None), form, view)
    except (ValueError, FileExistsError) as error:
        raise StopError(str(error)) from None
    out.print(f"{sum(rows.values())} rows of {len(rows)} views: {target}")


def _key(file: Path | None) -> bytes:
    """Read the key, which no message ever shows."""
    key = file.read_bytes().strip() if file else os.environ.get(KEY, "").strip().encode()
    if not key:
        raise StopError(f"pseudonyms need a key: name a file with --key-file or set {KEY}")
    return key
