"""Find flights whose pack flow was written in kg/min, by the aircraft's other flights.

Where a compressor is recorded too, its laws show the unit of a flow in the flight itself. Where none is, nothing does;
but no controller flies both packs at less than half of their usual flow.
"""

from math import sqrt

import polars as pl

from hdt_core.record.exchange import LEAST_FLIGHTS
from hdt_core.records.keys import AIRCRAFT, FLIGHT
from hdt_core.records.units import POUND_KG

OTHER_UNIT, KG_PER_MINUTE = "other_unit", "kg_per_minute"
"""Reason of such flights, and its cause."""
NEARER = sqrt(POUND_KG)
"""Ratio to the usual flow below which a flow in kg/min explains it better, and above which one in lb/min does."""
HIGH_QUANTILE = 0.9
"""Quantile of an aircraft's flows that is of a flight in lb/min, where a tenth of the flights are."""


def in_other_unit(flights: pl.DataFrame) -> pl.DataFrame:
    """Select the flights whose flow is nearer to the aircraft's usual one in kg/min.

    Parameters
    ----------
    flights : DataFrame
        `FLIGHT`, `highest_flow_kg_s`: the flow of the pack that flows most, read in the agreed unit.

    Returns
    -------
    DataFrame
        `FLIGHT`, `reason`, `likely_cause`.
    """
    flow = pl.col("highest_flow_kg_s")
    is_usual = flow > NEARER * flow.quantile(HIGH_QUANTILE)
    usual_flow = flow.filter(is_usual).median()
    ratio = pl.when(is_usual.sum() >= LEAST_FLIGHTS).then(flow / usual_flow)
    flown = flights.filter(flow > 0.0).with_columns(ratio.over(AIRCRAFT).alias("ratio"))
    slips = flown.filter(pl.col("ratio").is_between(POUND_KG * NEARER, NEARER))
    return slips.select(*FLIGHT, reason=pl.lit(OTHER_UNIT), likely_cause=pl.lit(KG_PER_MINUTE))
