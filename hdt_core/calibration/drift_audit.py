"""Audit the drift of each pack within the baseline.

A model that takes wear as normal hides it. The clean level is anchored in each pack's first flights and the baseline
ends at a milestone, so wear that came later cannot move it; wear before the milestone is reported here.
"""

import numpy as np
import polars as pl
from scipy.stats import theilslopes

from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.initial_wear import FIRST_FLIGHTS
from hdt_core.records.keys import IN_ORDER, PACK
from hdt_core.records.unit_index import number_units

MIN_FLIGHTS = 20
DRIFT_SD, LEAST_DRIFT = 3.0, 0.01
"""A drift is reported where it is both significant and at least one per cent in a hundred flights."""


def audit_drift(twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Estimate the drift of each unit's conductance over the baseline.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights` over the baseline flights.
    maintenance : DataFrame
        Replaced exchangers begin a new unit.
    dsm : Dsm
        The model of the flight estimates.

    Returns
    -------
    DataFrame
        One row a pack and unit of twenty flights or more, by pack: `n_flights`, `anchor` (ln conductance ratio of its
        first ten flights, above the clean fleet's), `drift_per_100_flights` (of the ratio, Theil and Sen's slope) with
        `drift_sd`, `unlearned` (ln ratio of its last ten flights below its first: what the anchor keeps out of the
        model), and `drifts` (bool).
    """
    flights = twin_flights.drop_nulls("ln_ua_ratio").sort(IN_ORDER)
    rows = [
        _audit_unit(dict(zip((*PACK, "unit"), key, strict=True)), unit["ln_ua_ratio"].to_numpy(), dsm.clean_level)
        for key, unit in number_units(flights, maintenance).group_by(*PACK, "unit", maintain_order=True)
        if unit.height >= MIN_FLIGHTS
    ]
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "unit": pl.Int64, "n_flights": pl.Int64}
    schema |= dict.fromkeys(("anchor", "drift_per_100_flights", "drift_sd", "unlearned"), pl.Float64)
    return pl.DataFrame(rows, schema={**schema, "drifts": pl.Boolean}).sort(*PACK, "unit")


def _audit_unit(keys: dict[str, object], ratio: np.ndarray, clean_level: float) -> dict[str, object]:
    slope = theilslopes(ratio, alpha=0.6827)
    sd = 0.5 * (slope.high_slope - slope.low_slope)
    first, last = float(np.median(ratio[:FIRST_FLIGHTS])), float(np.median(ratio[-FIRST_FLIGHTS:]))
    return keys | {
        "n_flights": len(ratio),
        "anchor": first - clean_level,
        "drift_per_100_flights": 100.0 * slope.slope,
        "drift_sd": 100.0 * sd,
        "unlearned": first - last,
        "drifts": bool(abs(slope.slope) > DRIFT_SD * sd and abs(100.0 * slope.slope) > LEAST_DRIFT),
    }
