"""What a file said before it came again with less: kept where the new one agrees, set aside where it does not."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from pipelines.intake.ledger import QUARANTINE_SCHEMA, Fault, quarantine
from pipelines.intake.merge import KEY, as_content, contradictions

ACCOUNT = ("file", "flight_id")
REPLACED = "replaced_row"


@dataclass(frozen=True, slots=True)
class Redelivery:
    """Rows of an earlier version of files that are still good, and what must be told."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame


def redelivered(
    rows: pl.DataFrame,
    aside: pl.DataFrame,
    stored: pl.DataFrame,
    stored_aside: pl.DataFrame,
    received_at: Mapping[str, datetime],
) -> Redelivery:
    """Compare what files hold of some flights now with what is stored of an earlier version of them.

    Parameters
    ----------
    rows, aside : DataFrame
        Good rows that the files hold now, and quarantine rows.
    stored, stored_aside : DataFrame
        Rows and quarantine rows that are stored under the names of these files.
    received_at : mapping
        When each file was received.

    Returns
    -------
    Redelivery
        Only a file counts that has some rows of a flight and fewer than are stored of it; one with none leaves the
        flight as it is, any other replaces it. Rows it lacks are `rows` where it contradicts none that it repeats,
        else quarantine rows; a note names the file and both counts.
    """
    replaced = stored_aside.filter(pl.col("reason") == REPLACED)
    before = _counted(stored.select(*ACCOUNT, n=pl.lit(1, pl.Int64)), replaced.select(*ACCOUNT, n="n_rows"))
    now = _counted(rows.select(*ACCOUNT, n=pl.lit(1, pl.Int64)), aside.select(*ACCOUNT, n="n_rows"))
    fewer = before.join(now, on=ACCOUNT, suffix="_now", validate="m:1").filter(pl.col("n_now") < pl.col("n"))
    if fewer.is_empty():
        return Redelivery(rows.clear(), pl.DataFrame(schema=QUARANTINE_SCHEMA))
    speaks = fewer.join(rows.select(ACCOUNT).unique(), on=ACCOUNT, how="semi")
    old = stored.join(speaks, on=ACCOUNT, how="semi")
    lacking = old.join(rows, on=(*KEY, "file"), how="anti")
    denied = _denied(old, rows)
    told = [
        *_notes(fewer, received_at),
        *_replaced(lacking.join(denied, on=ACCOUNT, how="semi"), received_at),
        replaced.join(fewer, on=ACCOUNT, how="semi").select(list(QUARANTINE_SCHEMA)),
    ]
    return Redelivery(lacking.join(denied, on=ACCOUNT, how="anti").select(rows.columns), pl.concat(told))


def _counted(*parts: pl.DataFrame) -> pl.DataFrame:
    return pl.concat(parts).group_by(ACCOUNT).agg(pl.col("n").sum())


def _denied(old: pl.DataFrame, rows: pl.DataFrame) -> pl.DataFrame:
    """Files and flights of which the new version gives another value than the old."""
    files = old["file"].unique().to_list()
    found = [contradictions(old.filter(file=f), rows.filter(file=f)).select(ACCOUNT) for f in files]
    return pl.concat([old.select(ACCOUNT).clear(), *found]).unique()


def _notes(fewer: pl.DataFrame, received_at: Mapping[str, datetime]) -> list[pl.DataFrame]:
    said = "It had {} rows of this flight and now has {}. What it lacks is kept."
    return [
        quarantine(file, received_at.get(file), [Fault("fewer_rows", detail=said.format(n, now), flight_id=flight)])
        for file, flight, n, now in fewer.sort(ACCOUNT).iter_rows()
    ]


def _replaced(rows: pl.DataFrame, received_at: Mapping[str, datetime]) -> list[pl.DataFrame]:
    return [
        quarantine(
            row["file"],
            received_at.get(row["file"]),
            [Fault(REPLACED, None, None, "", 1, row["flight_id"], as_content(row))],
        )
        for row in rows.sort(*ACCOUNT, "time_utc", "pack").iter_rows(named=True)
    ]
