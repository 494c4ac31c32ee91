"""Which version each stored cell should be of: the one place that decides what is stale.

A version is a hash over the versions of everything a cell is made from and the version of the code that makes it. A
cell is stale when the ledger's version of what is stored differs from the one expected now. Nothing is asked of the
clock, so late, repeated and out-of-order deliveries end where a clean delivery ends.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import polars as pl

from hdt_core.tables import TABLES
from pipelines.baseline import baseline_inputs
from pipelines.lineage import LINEAGE, Recipe, Stage
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import HOME_SETTINGS
from pipelines.storage.store import Aircraft

CELL = ("operator", "tail", "flight_id")
_DEPTH = {"flight": 3, "aircraft": 2, "fleet": 0}


def digest(*parts: str) -> str:
    """Short stable hash of some strings."""
    return hashlib.blake2b("\x1f".join(parts).encode(), digest_size=10).hexdigest()


def expected(ledger: Ledger, table: str) -> pl.DataFrame:
    """Version each cell of `table` should have now: operator, tail, flight_id (empty above flights), version."""
    return _expected(ledger, table, _parents(ledger, [table]))


def _expected(ledger: Ledger, table: str, parents: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    recipe, grain = LINEAGE[table], TABLES[table].grain
    if recipe.files:
        return _of_files(ledger, grain, recipe)
    if recipe.baseline:
        lines = digest(*baseline_inputs(ledger))
        return _hashed(pl.DataFrame({"made_of": [lines]}), recipe.code)
    if not recipe.parents:
        return _hashed(pl.DataFrame({"made_of": [table]}), recipe.code)
    first, *others = (parents[parent] for parent in recipe.parents)
    for other in others:
        on = [c for c in CELL if c in other.columns]
        first = first.join(other, on=on, how="left", validate="m:1") if on else first.join(other, how="cross")
    chosen = (value for setting in recipe.settings for value in HOME_SETTINGS[setting](ledger.home))
    return _hashed(first, " ".join((recipe.code, *chosen)))


def stale(ledger: Ledger, stage: Stage) -> pl.DataFrame:
    """Cells whose stored version is absent or not the expected one in some table of a stage.

    Tables of one recipe are stored and marked one after the other, in the stage's order, so the last of them speaks
    for all.
    """
    last = {recipe: table for table, recipe in stage.tables.items()}
    return undone(ledger, last.values()).unique().sort(CELL)


def made_as(ledger: Ledger, stages: Sequence[Stage]) -> str:
    """How cells are made now: stages, declared types, accepted terms, and the fleet's tables that finer ones follow."""
    parents = {p for stage in stages if stage.grain != "fleet" for p in stage.parents if TABLES[p].grain == "fleet"}
    fleet = ledger.of(())
    versions = (v for table in sorted(parents) for v in fleet.done(table)["version"])
    chosen = (value for read in HOME_SETTINGS.values() for value in read(ledger.home))
    return digest(repr(stages), _declared_types(), *chosen, *versions)


@cache
def _declared_types() -> str:
    return repr([(name, c.dtype) for entry in TABLES.values() for name, c in entry.schema.columns().items()])


def narrowed(ledger: Ledger, stage: Stage, aircraft: Iterable[Aircraft], flights: Iterable[str]) -> Ledger:
    """What the ledger says of some aircraft and, of a stage whose cells follow no aircraft as a whole, some flights."""
    own = stage.grain == "flight" and all(TABLES[parent].grain != "aircraft" for parent in stage.parents)
    return ledger.of(aircraft, flights if own else None)


def undone(ledger: Ledger, tables: Iterable[str]) -> pl.DataFrame:
    """Cells of some tables, of one grain, whose stored version is absent or not the expected one."""
    tables = list(tables)
    parents = _parents(ledger, tables)
    found = (_expected(ledger, t, parents).join(ledger.done(t), on=[*CELL, "version"], how="anti") for t in tables)
    return pl.concat(found)


def _of_files(ledger: Ledger, grain: str, recipe: Recipe) -> pl.DataFrame:
    if grain == "flight":
        held = ledger.holdings()
    else:
        line = pl.concat_str("path", "digest", separator="=").alias("line")
        held = ledger.files(recipe.files).with_columns(line, flight_id=pl.lit(""))
        if grain == "fleet":
            held = held.with_columns(operator=pl.lit(""), tail=pl.lit(""))
    lines = _folded(held.select(*CELL, "line"))
    if grain == "fleet" and not lines.height:
        lines = pl.DataFrame({"operator": [""], "tail": [""], "flight_id": [""], "made_of": [""]})
    return _hashed(lines, recipe.code)


def _folded(held: pl.DataFrame) -> pl.DataFrame:
    """Lines of each cell as one text, in order; most cells have a single line, which is left as it is."""
    several = pl.struct(CELL).is_duplicated()
    many = held.filter(several).group_by(CELL).agg(pl.col("line").sort().str.join("|"))
    return pl.concat([held.filter(~several), many]).rename({"line": "made_of"})


def _parents(ledger: Ledger, tables: Iterable[str]) -> dict[str, pl.DataFrame]:
    """Versions of all that some tables, of one grain, are made from, each in a column of its table's name."""
    recipes = [(LINEAGE[table], _DEPTH[TABLES[table].grain]) for table in tables]
    asked = {parent: depth for recipe, depth in recipes if not recipe.baseline for parent in recipe.parents}
    return {parent: _at(ledger, depth, parent) for parent, depth in asked.items()}


def _at(ledger: Ledger, depth: int, table: str) -> pl.DataFrame:
    """A table's versions at a depth of cells: finer ones folded into one hash, coarser ones as they are."""
    own = _DEPTH[TABLES[table].grain]
    if own <= depth:
        return ledger.done(table).select(*CELL[:own], pl.col("version").alias(table))
    held = ledger.lines(table)
    lines = pl.col("lines") if depth else pl.col("lines").str.join("|")
    return held.select(*CELL[:depth], lines.map_elements(_fold, return_dtype=pl.String).alias(table))


def _fold(lines: str) -> str:
    """One hash of lines in any order."""
    return digest("|".join(sorted(lines.split("|"))))


def _hashed(cells: pl.DataFrame, code: str) -> pl.DataFrame:
    made_of = [c for c in cells.columns if c not in CELL]
    line = pl.concat_str(*made_of, separator="|", ignore_nulls=True) if made_of else pl.lit("")
    full = cells.with_columns([pl.lit("").alias(c) for c in CELL if c not in cells.columns])
    hashed = full.with_columns(version=line.map_elements(lambda s: digest(code, s), return_dtype=pl.String))
    return hashed.select(*CELL, "version")
