"""Fit a declared component by any estimator: its design on nominal flights, its health flight by flight (the paper's
Figure 10)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array, flights_of
from hdt_core.calibration.diffuser_line import FAR_SD
from hdt_core.components import Component
from hdt_core.estimation import Estimate, Estimator, NonlinearLeastSquares, estimators
from hdt_core.estimation.batch import Batch
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.estimate import estimate_each
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.physics.model import PhysicsModel
from hdt_core.physics.sensor_errors import with_sensor_errors
from hdt_core.records.keys import FLIGHT_PACK, IN_ORDER
from hdt_core.robust import spread_expr

WITHOUT_ESTIMATE = ("diverged", "not_identifiable")
"""Statuses of a flight whose values are no estimate."""
MIN_SAMPLES, MIN_FLIGHTS = 3, 5
"""Samples of a flight from which it is estimated; flights from which their scatter is."""
LEAST_LOSS = -1.0
"""Lower bound of a loss counted from a fleet's part, of which a unit may be far better. [-]"""
CLOSED_FORM = "nls"
"""Method of which the night computes the answer on the pack's parts in closed form, sample by sample."""


def has_closed_form(part: Component) -> bool:
    """Check whether a part of the pack is estimated in closed form."""
    return part.estimator == CLOSED_FORM


def is_regular(column: str) -> pl.Expr:
    """Flag samples near their flight's median: a spike is none of a method's business."""
    deviation = (pl.col(column) - pl.col(column).median().over(FLIGHT_PACK)).abs()
    return deviation <= FAR_SD * spread_expr(deviation).over(FLIGHT_PACK)


def declared_estimator(component: Component) -> Estimator:
    """Return the method that the component declares.

    Raises
    ------
    ValueError
        No installed package has a method of this name.
    """
    methods = estimators()
    if component.estimator not in methods:
        raise ValueError(f"component {component.code}: estimator is {', '.join(methods)}, not {component.estimator}")
    return methods[component.estimator]


def calibrate_component(
    model: PhysicsModel, samples: pl.DataFrame, estimator: Estimator | None = None
) -> tuple[PhysicsModel, Estimate]:
    """Estimate the `design` parameters from nominal samples, health at its nominal value; a declared prior counts.

    Parameters
    ----------
    samples : DataFrame
        Columns named as the model's inputs and outputs.
    estimator : Estimator, optional
        Nonlinear least squares where not given.

    Returns
    -------
    PhysicsModel, Estimate
        The digital system model: the same declaration with the estimates as its nominal values; and the estimate. Its
        status is `weakly_identifiable` where the nominal samples leave a design parameter open, which `Estimate.weak`
        names: health at other flows or temperatures than theirs then rests on a guess.

    Raises
    ------
    ValueError
        The samples do not determine the design, or the estimate is not finite.
    """
    free = [p.name for p in model.free("design")]
    problem = samples_problem(samples, model, free, recorded_outputs(model, samples), declared_prior(model, free))
    return _calibrated(model, samples, (estimator or NonlinearLeastSquares()).estimate(problem))


def calibrate_with_sensors(
    model: PhysicsModel, samples: pl.DataFrame, estimator: Estimator | None = None
) -> tuple[PhysicsModel, Estimate]:
    """Estimate the `design` parameters as `calibrate_component`, with the declared errors of the sensors.

    Parameters
    ----------
    samples : DataFrame
        `FLIGHT_PACK` and columns named as the model's inputs and outputs.

    Returns
    -------
    PhysicsModel, Estimate
        Of `physics.sensor_errors.with_sensor_errors`; each declared standard deviation counts as prior, and samples of
        a flight share what the model leaves out.

    Raises
    ------
    ValueError
        As of `calibrate_component`.
    """
    model = with_sensor_errors(model)
    method = estimator or NonlinearLeastSquares()
    free = [p.name for p in model.free("design")]
    problem = samples_problem(samples, model, free, recorded_outputs(model, samples), partial_prior(model, free))
    estimate = method.estimate(problem)
    if estimate.status not in WITHOUT_ESTIMATE:
        sigma = sigma_with_flights(problem, estimate.belief.mean, samples)
        estimate = method.estimate(replace(problem, sigma=sigma))
    return _calibrated(model, samples, estimate)


def _calibrated(model: PhysicsModel, samples: pl.DataFrame, estimate: Estimate) -> tuple[PhysicsModel, Estimate]:
    """Return the model with the estimated design; raise where there is none."""
    free = [p.name for p in model.free("design")]
    if estimate.status in WITHOUT_ESTIMATE:
        raise ValueError(f"{model.name}: {', '.join(free)} from {samples.height} nominal samples: {estimate.status}")
    return model.calibrated(dict(zip(free, map(float, estimate.belief.mean), strict=True))), estimate


def sigma_with_flights(problem: Problem, theta: Array, samples: pl.DataFrame) -> Array:
    r"""Compute each output's sigma such that samples count no more than the flights that they are of. (m,)

    What the model leaves out is shared by the samples of a flight: independent, they would leave the design, and the
    errors of its sensors, far too sure.

    Parameters
    ----------
    problem : Problem
        Of `samples`, in their order.
    theta : array (n,)
        Estimate with the sensors' own noise.

    Notes
    -----
    With n samples a flight, sd s of the flights' mean residuals and sd r of the samples within:

    .. math:: \sigma^2 \to \sigma^2 + n \, \max(s^2 - r^2 / n, 0)
    """
    residual = problem.residual(theta) * problem.sigma
    names = [f"residual_{j}" for j in range(len(problem.sigma))]
    rows = samples.select(FLIGHT_PACK).with_columns(pl.Series(n, r) for n, r in zip(names, residual.T, strict=True))
    flights = rows.group_by(FLIGHT_PACK, maintain_order=True)
    means = flights.agg(pl.col(names).mean())
    within = flights.agg(pl.col(names).var())
    if means.height < MIN_FLIGHTS:
        return problem.sigma
    n_samples = samples.height / means.height
    between = means.select(pl.col(names).var()).to_numpy()[0]
    own = within.select(pl.col(names).mean()).to_numpy()[0] / n_samples
    return np.asarray(np.sqrt(problem.sigma**2 + n_samples * np.maximum(between - own, 0.0)))


def design_prior(model: PhysicsModel) -> Belief | None:
    """Return the declared prior of the design; None where a parameter has no standard deviation."""
    return declared_prior(model, [p.name for p in model.free("design")])


def declared_prior(model: PhysicsModel, names: Sequence[str]) -> Belief | None:
    """Return the declared prior of some parameters; None where one has no standard deviation."""
    free = [model.param(name) for name in names]
    sd = [p.sd for p in free if p.sd is not None]
    return Belief(np.array([p.nominal for p in free]), np.diag(np.square(sd))) if len(sd) == len(free) else None


def partial_prior(model: PhysicsModel, names: Sequence[str]) -> Belief:
    """Return the declared prior of some parameters, of infinite variance where one has no standard deviation."""
    free = [model.param(name) for name in names]
    sd = np.array([np.inf if p.sd is None else p.sd for p in free])
    return Belief(np.array([p.nominal for p in free]), np.diag(sd**2))


def flight_by_flight(
    samples: pl.DataFrame,
    model: PhysicsModel,
    free: Sequence[str],
    *,
    outputs: Sequence[str] | None = None,
    estimator: Estimator | None = None,
    prior: Belief | None = None,
    min_samples: int = MIN_SAMPLES,
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
    prior : Belief, optional
        Of every flight; nothing is assumed where it is not given.
    min_samples : int
        Samples from which a flight is estimated.

    Returns
    -------
    DataFrame
        One row a flight and pack of so many samples, in order: `FLIGHT_PACK`, `departed_at`, a column and an
        `_sd` for each of `free`, `status`, `n_evals` (model evaluations).

    Notes
    -----
    Least squares starts every flight in the middle of the declared bounds, so that all are estimated side by side;
    another method, as the paper, at the last estimate that converged. Both end on the same optimum.
    """
    outputs = recorded_outputs(model, samples) if outputs is None else outputs
    order = flights_of(samples).select(*FLIGHT_PACK, "departed_at")
    complete = samples.drop_nulls([*(s.name for s in model.inputs), *outputs]).drop("departed_at", strict=False)
    complete = complete.filter(pl.len().over(FLIGHT_PACK) >= min_samples)
    complete = complete.join(order, on=FLIGHT_PACK, validate="m:1").sort(*IN_ORDER, "time_utc")
    start = np.array([model.param(name).bounds for name in free]).mean(axis=1)
    problem = samples_problem(complete, model, free, outputs, unknown(start) if prior is None else prior)
    key = pl.struct(FLIGHT_PACK)
    flights_of_samples = Batch.of(problem, complete.select(key.rle_id().cast(pl.Int64))[:, 0].to_numpy())
    estimates = estimate_each(estimator or NonlinearLeastSquares(), flights_of_samples) if complete.height else []
    posterior = [(*e.belief.mean.tolist(), *e.belief.sd.tolist(), e.status, e.n_evals) for e in estimates]
    schema = dict.fromkeys((*free, *(f"{name}_sd" for name in free)), pl.Float64())
    values = pl.DataFrame(posterior, schema=schema | {"status": pl.String(), "n_evals": pl.Int64()}, orient="row")
    flights = complete.select(*FLIGHT_PACK, "departed_at").unique(maintain_order=True)
    return pl.concat([flights, values], how="horizontal")


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
