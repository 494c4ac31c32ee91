"""What each stored cell should be made of: the one place that decides what is stale.

A version is a hash over the versions of everything a cell is made from and the version of the code that makes it. A
cell is stale when the ledger's version of what is stored differs from the one expected now. Nothing is asked of the
clock, so late, repeated and out-of-order deliveries end where a clean delivery ends.
"""

import hashlib
from dataclasses import dataclass

import polars as pl

from hdt_core.tables import TABLES
from pipelines.baseline import baseline_inputs
from pipelines.ledger import Ledger

CELL = ("operator", "tail", "flight_id")
_DEPTH = {"flight": 3, "aircraft": 2, "fleet": 0}


@dataclass(frozen=True, slots=True)
class Made:
    """How a table is made: from which tables, or from which kinds of delivered file, by which version of the code.

    With `baseline` only the commissioning window of its parents counts.
    """

    parents: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    baseline: bool = False
    code: str = "1"


FLIGHT_FILES = ("acms", "history", "cpl")

MADE: dict[str, Made] = {
    **dict.fromkeys(
        ("raw_snapshots", "raw_logs", "raw_deliveries", "raw_quarantine", "raw_flights"),
        Made(files=FLIGHT_FILES, code="2"),
    ),
    "raw_messages": Made(files=("messages",), code="2"),
    "raw_maintenance": Made(files=("maintenance",), code="3"),
    **dict.fromkeys(
        ("raw_records_deliveries", "raw_records_quarantine"), Made(files=("messages", "maintenance"), code="2")
    ),
    **dict.fromkeys(
        ("raw_fleet", "raw_files_deliveries", "raw_files_quarantine"), Made(files=("fleet", "rejected", "refused"))
    ),
    **dict.fromkeys(("legs_samples", "legs_verdicts"), Made(("raw_flights",), code="2")),
    **dict.fromkeys(
        ("calibration_dsm", "calibration_design", "calibration_laws"), Made(("legs_samples",), baseline=True, code="9")
    ),
    "twin_flights": Made(("legs_samples", "calibration_dsm"), code="4"),
    "residuals": Made(("twin_flights",), code="2"),
    **dict.fromkeys(("twin_health", "twin_chapters"), Made(("twin_flights", "raw_maintenance"), code="11")),
    **dict.fromkeys(("legs_signs", "features_witnesses"), Made(("legs_samples", "calibration_laws"))),
    "features_margin": Made(("legs_samples", "calibration_dsm", "calibration_laws")),
    "legs_admitted": Made(("twin_health", "legs_signs", "raw_messages", "raw_maintenance"), code="4"),
    "features": Made(
        ("twin_health", "residuals", "features_witnesses", "features_margin", "raw_maintenance"), code="7"
    ),
    "features_alerts": Made(("features",), code="9"),
    "prognosis_base": Made(code="2"),
    # what a model has spoken about is stored with it, so prognoses come first: a kill between them costs only work
    **dict.fromkeys(
        ("prognoses", "prognosis_model"),
        Made(("features", "features_margin", "prognosis_base", "raw_messages", "raw_maintenance"), code="5"),
    ),
}


def digest(*parts: str) -> str:
    """Short stable hash of some strings."""
    return hashlib.blake2b("\x1f".join(parts).encode(), digest_size=10).hexdigest()


def expected(ledger: Ledger, table: str) -> pl.DataFrame:
    """Version each cell of `table` should have now: operator, tail, flight_id (empty above flights), version."""
    made, grain = MADE[table], TABLES[table].grain
    if made.files:
        return _of_files(ledger, grain, made)
    if made.baseline:
        lines = digest(*baseline_inputs(ledger))
        return _hashed(pl.DataFrame({"made_of": [lines]}), made.code)
    if not made.parents:
        return _hashed(pl.DataFrame({"made_of": [table]}), made.code)
    first, *others = (_at(grain, ledger.done(parent), parent) for parent in made.parents)
    for other in others:
        on = [c for c in CELL if c in other.columns]
        first = first.join(other, on=on, how="left") if on else first.join(other, how="cross")
    return _hashed(first, made.code)


def stale(ledger: Ledger, *node: str) -> pl.DataFrame:
    """Cells whose stored version is absent or not the expected one in some table of a node of the chain.

    Tables made alike are stored and marked one after the other, in the order in which the node names them, so the last
    of them speaks for all.
    """
    last = {MADE[table]: table for table in node}
    return pl.concat(_undone(ledger, table) for table in last.values()).unique().sort(CELL)


def _undone(ledger: Ledger, table: str) -> pl.DataFrame:
    return expected(ledger, table).join(ledger.done(table), on=[*CELL, "version"], how="anti")


def _of_files(ledger: Ledger, grain: str, made: Made) -> pl.DataFrame:
    if grain == "flight":
        held = ledger.holdings()
    else:
        line = pl.concat_str("path", "digest", separator="=").alias("line")
        held = ledger.files(made.files).with_columns(line, flight_id=pl.lit(""))
        if grain == "fleet":
            held = held.with_columns(operator=pl.lit(""), tail=pl.lit(""))
    lines = _folded(held.select(*CELL, "line"))
    if grain == "fleet" and not lines.height:
        lines = pl.DataFrame({"operator": [""], "tail": [""], "flight_id": [""], "made_of": [""]})
    return _hashed(lines, made.code)


def _folded(held: pl.DataFrame) -> pl.DataFrame:
    """Lines of each cell as one text, in order; most cells have a single line, which is left as it is."""
    several = pl.struct(CELL).is_duplicated()
    many = held.filter(several).group_by(CELL).agg(pl.col("line").sort().str.join("|"))
    return pl.concat([held.filter(~several), many]).rename({"line": "made_of"})


def _at(grain: str, versions: pl.DataFrame, name: str) -> pl.DataFrame:
    """A parent's versions at the child's grain: finer ones folded into one hash, coarser ones as they are."""
    depth = min(_DEPTH[grain], _DEPTH[TABLES[name].grain])
    if depth == _DEPTH[TABLES[name].grain]:
        return versions.select(*CELL[:depth], pl.col("version").alias(name))
    line = pl.concat_str(*CELL, "version", separator="=").sort().str.join("|").alias(name)
    folded = versions.group_by(CELL[:depth]).agg(line) if depth else versions.select(line)
    return folded.with_columns(pl.col(name).map_elements(digest, return_dtype=pl.String))


def _hashed(cells: pl.DataFrame, code: str) -> pl.DataFrame:
    made_of = [c for c in cells.columns if c not in CELL]
    line = pl.concat_str(*made_of, separator="|", ignore_nulls=True) if made_of else pl.lit("")
    full = cells.with_columns([pl.lit("").alias(c) for c in CELL if c not in cells.columns])
    hashed = full.with_columns(version=line.map_elements(lambda s: digest(code, s), return_dtype=pl.String))
    return hashed.select(*CELL, "version")
