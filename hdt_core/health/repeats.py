"""Repeat offenders: a position that wears one unit after the other has a cause that no new unit takes away."""

from datetime import timedelta

import polars as pl

from hdt_core.health import phrases
from hdt_core.health.diagnoses import Diagnosis
from hdt_core.health.episodes import REPAIR, Case
from hdt_core.health.grid import Grid
from hdt_core.records.unit_index import NEW_UNIT, select_entries

REPEAT_DAYS = 90
"""Days within which units of one position are counted."""
REPEAT_UNITS = 3
"""The unit in so many days that asks for another action than the next one."""


def count_units(grid: Grid, maintenance: pl.DataFrame, case: Case, said: Diagnosis) -> int | None:
    """Units that this position has had in the `REPEAT_DAYS` before the case was raised, its own included.

    None where the log's component is no single unit: sensors and what drives a door.
    """
    if said.ended_by == REPAIR:
        return None
    operator, tail, pack = grid.units.row(case.unit)
    raised: pl.Expr = pl.lit(grid.at("departed_at", case.unit, case.raised))
    own = maintenance.filter(operator=operator, tail=tail, pack=pack)
    came = select_entries(own, (said.component,), NEW_UNIT)["counts_from"].to_frame()
    late = came.filter((pl.col("counts_from") <= raised) & (pl.col("counts_from") > raised - timedelta(REPEAT_DAYS)))
    return 1 + late.height


def action_of(said: Diagnosis, units: int | None) -> str:
    """What to do; of a position that has had too many units, find out why first."""
    if units is None or units < REPEAT_UNITS:
        return said.action
    then = f"{said.action[0].lower()}{said.action[1:]}"
    return phrases.UPSTREAM.format(units=units, days=REPEAT_DAYS) + phrases.THEN + then
