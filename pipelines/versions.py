"""Compute the version that each stored cell should have, and thereby the stale cells.

A version is a hash over the versions of a cell's inputs and of the code that computes it. A cell is stale when its
version in the ledger differs from the one expected now. The clock plays no part, so late, repeated and out-of-order
deliveries end in the same state as a clean one.
"""

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from typing import Literal

import polars as pl

from hdt_core.flight.legs import baseline_flights
from hdt_core.tables import TABLES
from pipelines.lineage import HELD, LINEAGE, Recipe, Stage
from pipelines.record import held_flights, is_any_due, judge_record
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import HOME_SETTINGS, accepted_terms
from pipelines.storage.store import Aircraft, Store

CELL = ("operator", "tail", "flight_id")
_DEPTH = {"flight": 3, "aircraft": 2, "fleet": 0}


def digest(*parts: str) -> str:
    """Hash some strings, short and stable."""
    return hashlib.blake2b("\x1f".join(parts).encode(), digest_size=10).hexdigest()


def expected_versions(ledger: Ledger, table: str) -> pl.DataFrame:
    """List the version each cell of `table` should have: operator, tail, flight_id (empty above flights), version."""
    return _expected_versions(ledger, table, _parents(ledger, [table])[0])


def _expected_versions(ledger: Ledger, table: str, parents: Mapping[str, pl.DataFrame]) -> pl.DataFrame:
    recipe = LINEAGE[table]
    grain = TABLES[table].grain
    settings = (value for name in recipe.settings for value in HOME_SETTINGS[name](ledger.home))
    code = " ".join((recipe.code, *settings))
    if recipe.files:
        return _file_versions(ledger, grain, recipe)
    if recipe.sisters:
        return _with_version(pl.DataFrame({"made_of": [digest(*level_lines(Store(ledger.home)))]}), code)
    if recipe.baseline or recipe.judged:
        lines = baseline_inputs(ledger) if recipe.baseline else map(str, judge_record(ledger).rows())
        return _with_version(pl.DataFrame({"made_of": [digest(*lines)]}), code)
    if not recipe.parents:
        return _with_version(pl.DataFrame({"made_of": [table]}), recipe.code)
    first, *others = (parents[parent] for parent in recipe.parents)
    for place, other in enumerate(others, 1):
        on = [c for c in CELL if c in other.columns]
        how: Literal["full", "left"] = "full" if place < recipe.n_cell_parents else "left"
        first = (
            first.join(other, on=on, how=how, coalesce=True, validate="m:1") if on else first.join(other, how="cross")
        )
    return _with_version(first, code)


def find_stale_cells(ledger: Ledger, stage: Stage) -> pl.DataFrame:
    """List cells whose stored version is absent or not the expected one in some table of a stage.

    Tables of one recipe are stored and marked one after the other, in the stage's order, so the last one represents
    all of them.
    """
    last = {recipe: table for table, recipe in stage.tables.items()}
    return stale_cells_of(ledger, last.values()).unique().sort(CELL)


def recipe_version(ledger: Ledger, stages: Sequence[Stage]) -> str:
    """Hash all that determines cells beside their inputs: stages, column types, accepted terms, the fleet's tables.

    And whether a flight that lay after the clock is due.
    """
    parents = {p for stage in stages if stage.grain != "fleet" for p in stage.parents if TABLES[p].grain == "fleet"}
    versions = (v for cells in ledger.of(()).cells_of(sorted(parents)).values() for v in cells["version"])
    settings = (value for read in HOME_SETTINGS.values() for value in read(ledger.home))
    return digest(repr(stages), _declared_types(), *settings, *versions, *(["due"] if is_any_due(ledger) else []))


@cache
def _declared_types() -> str:
    return repr([(name, c.dtype) for entry in TABLES.values() for name, c in entry.schema.columns().items()])


def restrict_ledger(ledger: Ledger, stage: Stage, aircraft: Iterable[Aircraft], flights: Iterable[str]) -> Ledger:
    """Restrict the ledger to some aircraft and, for a stage whose cells depend on single flights, to some flights."""
    own = stage.grain == "flight" and all(TABLES[parent].grain != "aircraft" for parent in stage.parents)
    return ledger.of(aircraft, flights if own else None)


def stale_cells_of(ledger: Ledger, tables: Iterable[str]) -> pl.DataFrame:
    """List cells of some tables, of one grain, whose stored version is absent or not the expected one."""
    tables = list(tables)
    parents, stored = _parents(ledger, tables, tables)
    return pl.concat(
        _expected_versions(ledger, t, parents).join(stored[t], on=[*CELL, "version"], how="anti") for t in tables
    )


def _file_versions(ledger: Ledger, grain: str, recipe: Recipe) -> pl.DataFrame:
    if grain == "flight":
        files = ledger.flight_inputs()
    else:
        line = pl.concat_str("path", "digest", separator="=").alias("line")
        files = ledger.files(recipe.files).with_columns(line, flight_id=pl.lit(""))
        if grain == "fleet":
            files = files.with_columns(operator=pl.lit(""), tail=pl.lit(""))
    lines = _join_lines(files.select(*CELL, "line"))
    if grain == "fleet" and not lines.height:
        lines = pl.DataFrame({"operator": [""], "tail": [""], "flight_id": [""], "made_of": [""]})
    return _with_version(lines, recipe.code)


def _join_lines(lines: pl.DataFrame) -> pl.DataFrame:
    """Join the lines of each cell into one text, in order; most cells have a single line."""
    several = pl.struct(CELL).is_duplicated()
    many = lines.filter(several).group_by(CELL).agg(pl.col("line").sort().str.join("|"))
    return pl.concat([lines.filter(~several), many]).rename({"line": "made_of"})


def _parents(
    ledger: Ledger, tables: Iterable[str], also: Iterable[str] = ()
) -> tuple[dict[str, pl.DataFrame], dict[str, pl.DataFrame]]:
    """Read the versions of all parents of some tables of one grain, each in a column of its table's name.

    In the same transaction the stored cells of the tables `also`, of that grain.
    """
    recipes = [(LINEAGE[table], _DEPTH[TABLES[table].grain]) for table in tables]
    by_version = [(recipe, depth) for recipe, depth in recipes if not (recipe.baseline or recipe.sisters)]
    depths = {parent: depth for recipe, depth in by_version for parent in recipe.parents}
    finer = [parent for parent, depth in depths.items() if _DEPTH[TABLES[parent].grain] > depth]
    stored = ledger.cells_of([*(parent for parent in depths if parent not in finer), *also], finer)
    versions = {parent: _versions_at(stored[parent], depth, parent) for parent, depth in depths.items()}
    if HELD in versions:
        versions[HELD] = _held_at(ledger, depths[HELD])
    return versions, stored


def _held_at(ledger: Ledger, depth: int) -> pl.DataFrame:
    """Return the held flights as versions at a depth of cells: a cell without one has none."""
    line = pl.concat_str("flight_id", "reason", separator="=")
    return held_flights(ledger).group_by(CELL[:depth]).agg(line.sort().str.join("|").alias(HELD))


def _versions_at(stored: pl.DataFrame, depth: int, table: str) -> pl.DataFrame:
    """Return a table's versions at a depth of cells: finer ones hashed into one, coarser ones unchanged."""
    own = _DEPTH[TABLES[table].grain]
    if own <= depth:
        return stored.select(*CELL[:own], pl.col("version").alias(table))
    lines = pl.col("lines") if depth else pl.col("lines").str.join("|")
    return stored.select(*CELL[:depth], lines.map_elements(_hash_lines, return_dtype=pl.String).alias(table))


def _hash_lines(lines: str) -> str:
    """Hash lines independently of their order."""
    return digest("|".join(sorted(lines.split("|"))))


def _with_version(cells: pl.DataFrame, code: str) -> pl.DataFrame:
    made_of = [c for c in cells.columns if c not in CELL]
    line = pl.concat_str(*made_of, separator="|", ignore_nulls=True) if made_of else pl.lit("")
    full = cells.with_columns([pl.lit("").alias(c) for c in CELL if c not in cells.columns])
    versions = full.with_columns(version=line.map_elements(lambda s: digest(code, s), return_dtype=pl.String))
    return versions.select(*CELL, "version")


def baseline_cells(ledger: Ledger) -> pl.DataFrame:
    """Return the commissioning window: operator, tail, flight_id, version. A flight id sorts by day and leg.

    A flight of which nothing is stored, such as one whose rows were all refused, takes no place in it.
    """
    with_rows = Store(ledger.home).scan("legs_verdicts").select(CELL).unique().collect()
    cells = ledger.cells("legs_samples").join(with_rows, on=CELL, how="semi")
    flights = baseline_flights(cells.with_columns(departed_at=pl.col("flight_id").str.slice(-11)))
    return cells.filter(pl.col("flight_id").is_in(flights))


def baseline_records(store: Store, table: str, cells: pl.DataFrame) -> pl.DataFrame:
    """Read messages, maintenance or printed reports up to the day of each aircraft's last baseline flight."""
    return records_until(store.read_table(table), cells)


def records_until(records: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Return the records up to the day of each aircraft's last flight in `cells`."""
    on = next(pl.col(c).cast(pl.Date) for c in ("message_time", "reported_at", "done_on") if c in records.columns)
    day = pl.col("flight_id").str.slice(-11, 8).str.to_date("%Y%m%d").max().alias("last_day")
    last = cells.group_by("operator", "tail").agg(day)
    return records.join(last, on=["operator", "tail"], validate="m:1").filter(on <= pl.col("last_day")).drop("last_day")


def baseline_inputs(ledger: Ledger) -> list[str]:
    """Return the model's inputs as lines to be hashed."""
    store = Store(ledger.home)
    cells = baseline_cells(ledger)
    records = [baseline_records(store, t, cells) for t in ("raw_messages", "raw_maintenance", "raw_reports")]
    terms = [f"term {name}" for name in accepted_terms(ledger.home)]
    return [line for frame in (cells, *records) for line in sorted(map(str, frame.rows()))] + terms


def level_lines(store: Store) -> list[str]:
    """Return the levels of all packs' first flights as lines to be hashed."""
    levels = store.scan("calibration_components").filter(pl.col("parameter").str.ends_with("_level")).collect()
    return sorted(map(str, levels.select(CELL[0], CELL[1], "pack", "component", "value", "sd").rows()))
