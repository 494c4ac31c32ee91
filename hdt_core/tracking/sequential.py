"""Estimate flight by flight with any estimator, each flight starting at the last estimate: the paper's Figure 10.

For any declared model. The fleet uses the closed form of `calibration.flight_estimates` and `calibration.compressor`,
which gives the same estimates.
"""

from collections.abc import Sequence

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import flights_of
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.estimate import Estimator
from hdt_core.estimation.nls import NonlinearLeastSquares
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.physics.model import PhysicsModel
from hdt_core.records.keys import FLIGHT_PACK, IN_ORDER, PACK

MIN_SAMPLES = 3


def flight_by_flight(
    samples: pl.DataFrame,
    model: PhysicsModel,
    free: Sequence[str],
    *,
    outputs: Sequence[str] | None = None,
    estimator: Estimator | None = None,
    warm: bool = True,
) -> pl.DataFrame:
    """Estimate parameters `free` of `model` from every flight and pack alone, all others at their nominal values.

    Parameters
    ----------
    samples : DataFrame
        `PACK`, `flight_id`, `time_utc` and columns named as the model's inputs and outputs; nominal or steady samples.
    outputs : sequence of str, optional
        Outputs to compare; all that have a sensor and a column where not given.
    estimator : Estimator, optional
        Nonlinear least squares, the paper's, where not given.
    warm : bool
        Start each flight from the pack's last estimate that converged; otherwise from the middle of the declared
        bounds. It is a start and no prior.

    Returns
    -------
    DataFrame
        One row a flight and pack of three samples or more, in order: `FLIGHT_PACK`, `departed_at`, a column and an
        `_sd` for each of `free`, `status`, `n_evals` (model evaluations).
    """
    outputs = recorded_outputs(model, samples) if outputs is None else outputs
    order = flights_of(samples).select(*FLIGHT_PACK, "departed_at")
    complete = samples.drop_nulls([*(s.name for s in model.inputs), *outputs]).drop("departed_at", strict=False)
    complete = complete.join(order, on=FLIGHT_PACK, validate="m:1").sort(*IN_ORDER, "time_utc")
    solve = NonlinearLeastSquares() if estimator is None else estimator
    rows = []
    for _, pack in complete.group_by(PACK, maintain_order=True):
        start = np.array([model.param(name).bounds for name in free]).mean(axis=1)
        for _, flight in pack.group_by("flight_id", maintain_order=True):
            if flight.height < MIN_SAMPLES:
                continue
            estimate = solve.estimate(samples_problem(flight, model, free, outputs, unknown(start)))
            if warm and estimate.status == "converged":
                start = estimate.belief.mean
            posterior = (*estimate.belief.mean.tolist(), *estimate.belief.sd.tolist())
            key = flight.select(*FLIGHT_PACK, "departed_at").row(0)
            rows.append((*key, *posterior, estimate.status, estimate.n_evals))
    schema = {c: complete.schema[c] for c in (*FLIGHT_PACK, "departed_at")}
    schema |= dict.fromkeys((*free, *(f"{name}_sd" for name in free)), pl.Float64())
    return pl.DataFrame(rows, schema=schema | {"status": pl.String(), "n_evals": pl.Int64()}, orient="row")


def recorded_outputs(model: PhysicsModel, samples: pl.DataFrame) -> list[str]:
    """List outputs of the model that have a sensor and a column.

    Raises
    ------
    ValueError
        There is none.
    """
    sensors = [s.name for s in model.outputs if s.sigma is not None]
    outputs = [name for name in sensors if name in samples.columns]
    if not outputs:
        raise ValueError(
            f"{model.name}: the samples hold no column of {', '.join(sensors) or 'an output with a sigma'}"
        )
    return outputs


def samples_problem(
    samples: pl.DataFrame,
    model: PhysicsModel,
    free: Sequence[str],
    outputs: Sequence[str],
    prior: Belief | None = None,
) -> Problem:
    """Build the estimation problem of `samples`."""
    inputs = {s.name: samples[s.name].to_numpy() for s in model.inputs}
    return declared_problem(model, free, inputs, {name: samples[name].to_numpy() for name in outputs}, prior=prior)
