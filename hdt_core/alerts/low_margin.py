"""Low margin: the reserve before the message is gone, or will be, though wear alone does not explain it.

On a type with little reserve, or in a hot season, a hardly worn exchanger leaves its level with the ram door full open.
What to do then is another thing than a new exchanger, so it has a diagnosis of its own.
"""

import numpy as np
import polars as pl

from hdt_core.alerts.cases import Case, Limits, spells
from hdt_core.alerts.grid import Grid
from hdt_core.health.detection import Array, persistent, since

SETTLED = 1
"""Flights of a new or washed unit before its margin is believed; four of five must say so as it is."""
FACTS = ("hx_margin_k", "hx_passage_300", "hx_fouling", "hx_fouling_sd", "overheat_p20_k")


def low_margin_cases(grid: Grid, maintenance: pl.DataFrame, limits: Limits, sick: Array) -> list[Case]:
    """Packs whose message is to be expected within 300 flights though their loss is below its limit.

    Parameters
    ----------
    grid : Grid
        With `hx_passage_300` and the margin's features; packs without them have no case.
    maintenance : DataFrame
        Log of work; a new or washed unit begins anew.
    limits : Limits
        Where belief turns into a case.
    sick : array
        (units, flights) bool: where a door or the outlet is in doubt.
    """
    ended = grid.worked_on(maintenance, ("HX",), ("REPLACED", "CLEANED"))
    soon, loss = np.nan_to_num(grid.values("hx_passage_300")), grid.values("hx_fouling")
    sure = (soon > limits.passage) & (since(ended) > SETTLED) & ~sick
    sure = grid.as_observed(sure, "hx_fouling", ended)
    low = persistent(sure, 4, 5, 20, keep=soon > 0.6 * limits.passage, ended=ended)
    cases = []
    for unit, first, end in spells(low, ended):
        if loss[unit, first] > limits.fouling:
            continue  # wear explains it, and says so
        facts = {name: float(grid.track(name, unit)[first]) for name in FACTS}
        small = np.nonzero(~(soon[unit, : first + 1] > limits.passage))[0]
        began = int(small[-1]) + 1 if small.size else 0
        cases.append(Case(unit, "HX", "HX_LOW_MARGIN", first, end, facts | {"since": began}))
    return cases
