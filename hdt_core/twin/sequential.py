"""The paper's Figure 10 taken literally: nonlinear least squares flight by flight, each from where the last one ended.

The fleet's path is the closed form of `hdt_core.twin.compressor`; this one shows that both end at the same place.
"""

from collections.abc import Iterator

import numpy as np
import polars as pl

from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.nls import NonlinearLeastSquares
from hdt_core.estimation.problem import unknown
from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.twin.crossing import PACK

FREE = ("cc_area_diameter_tan_beta_m3", "cc_diameter_vda_intercept")
INPUTS, OUTPUTS = ("cc_speed_rad_s", "cc_in_k", "cc_in_pa", "vda_counts"), ("cc_flow_kg_s", "cc_out_pa")
MIN_SAMPLES = 3


def flight_by_flight(samples: pl.DataFrame, *, warm: bool = True) -> pl.DataFrame:
    """Group of equations (2)-(4) and intercept of equation (6) of every flight and pack, by nonlinear least squares.

    Parameters
    ----------
    samples : DataFrame
        Cruise samples of nominal flights, signals in SI.
    warm : bool
        Start each flight from the estimate of the pack's flight before; the first, and without it every one, from the
        middle of the declared bounds.

    Returns
    -------
    DataFrame
        One row a flight and pack of three samples or more: `group_m3`, `intercept_m` at the declared nominal slope,
        `status`, `n_evals` (model evaluations).
    """
    known = samples.drop_nulls([*INPUTS, *OUTPUTS]).sort(*PACK, "time_utc", "flight_id")
    rows = [row for _, pack in known.group_by(PACK, maintain_order=True) for row in _one_pack(pack, warm=warm)]
    schema = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "flight_id": pl.String}
    schema |= {"group_m3": pl.Float64, "intercept_m": pl.Float64, "status": pl.String, "n_evals": pl.Int64}
    return pl.DataFrame(rows, schema=schema, orient="row")


def _one_pack(pack: pl.DataFrame, *, warm: bool) -> Iterator[tuple[object, ...]]:
    bounds = np.array([p.bounds for name in FREE for p in COMPRESSOR.params if p.name == name])
    first = start = bounds.mean(axis=1)
    estimator = NonlinearLeastSquares()
    for _, flight in pack.group_by("flight_id", maintain_order=True):
        if flight.height < MIN_SAMPLES:
            continue
        inputs, measured = ({c: flight[c].to_numpy() for c in names} for names in (INPUTS, OUTPUTS))
        found = estimator.estimate(declared_problem(COMPRESSOR, FREE, inputs, measured, prior=unknown(start)))
        # a flight that ended nowhere is no place to start from
        start = found.belief.mean if warm and found.status == "converged" else first if not warm else start
        yield *flight.select(*PACK, "flight_id").row(0), *map(float, found.belief.mean), found.status, found.n_evals
