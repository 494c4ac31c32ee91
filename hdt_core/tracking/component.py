"""Calibrate a declared component on nominal flights, estimate it flight by flight with any estimator (the paper's
Figure 10) and filter its health along them.

The pack's own parts use the closed form of `calibration.flight_estimates` and `calibration.compressor`, which gives the
same estimates.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array, flights_of
from hdt_core.calibration.baseline_wear import ENTRY, MIN_FLIGHT_SD, EntryWear
from hdt_core.components import Component
from hdt_core.components.declaration import CLEANED
from hdt_core.components.pack import HX
from hdt_core.estimation import Estimate, Estimator, NonlinearLeastSquares, estimators
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.estimate import estimate_each
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.physics.model import Param, PhysicsModel
from hdt_core.records.keys import FLIGHT_PACK, IN_ORDER, split_packs
from hdt_core.robust import MAD_TO_SD
from hdt_core.tracking.loss_filter import Loss, TrackResult, join_tracks, track_loss
from hdt_core.tracking.segments import SEGMENT_FLIGHTS
from hdt_core.tracking.wear_model import PACES, UNIT_SD, WEAR_STEP, Pace, Settings

LEAST_STEPS = 8
"""Steps between flights from which their scatter is estimated."""
SUDDEN_LOSS, FAULT_CHANCE, OFFSET_BIN = (0.2, 0.2), 1e-6, 0.03
"""Sudden losses are of any size, and with no second sensor a step is rather the part's than a fault's."""
WASH_SHARE = 0.5
"""Of the work that the log lacks, on a component that is cleaned."""
UNKNOWN_SD = 0.3
"""Of a design without a declared prior, about the calibrated one. [ln loss]"""
WITHOUT_ESTIMATE = ("diverged", "not_identifiable")
"""Statuses of a flight whose values are no estimate."""
MIN_SAMPLES = 3


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
    problem = samples_problem(samples, model, free, recorded_outputs(model, samples), design_prior(model))
    estimate = (estimator or NonlinearLeastSquares()).estimate(problem)
    if estimate.status in WITHOUT_ESTIMATE:
        raise ValueError(f"{model.name}: {', '.join(free)} from {samples.height} nominal samples: {estimate.status}")
    return model.calibrated(dict(zip(free, map(float, estimate.belief.mean), strict=True))), estimate


def design_prior(model: PhysicsModel) -> Belief | None:
    """Return the declared prior of the design; None where a parameter has no standard deviation."""
    free = model.free("design")
    sd = [p.sd for p in free if p.sd is not None]
    return Belief(np.array([p.nominal for p in free]), np.diag(np.square(sd))) if len(sd) == len(free) else None


class DesignOffset(NamedTuple):
    """Offset of a pack's declared design from the calibrated one, in the units of wear, with its sd."""

    shift: float = 0.0
    sd: float = UNKNOWN_SD


def track_component(
    flights: pl.DataFrame,
    component: Component,
    maintenance: pl.DataFrame,
    offset: DesignOffset | None = None,
    previous: TrackResult | None = None,
    seal: str = "",
) -> TrackResult:
    """Filter the health parameters of every flight along each pack.

    The filter is the exchanger's, for units that differ, enter worn, are renewed and washed, with wear scaled to the
    component: losses by the loss at which it fails, rates by its life, the walk of wear by the declared drift.

    Parameters
    ----------
    flights : DataFrame
        Of `flight_by_flight` with the health parameters free; whole packs.
    component : Component
        Entries of the log with its `ended_by` count.
    maintenance : DataFrame
        `operator, tail, pack, component, action, done_on`.
    offset : DesignOffset, optional
        Offset of the declared design.
    previous, seal
        As of `track_loss`.

    Returns
    -------
    TrackResult
        A flight's weight follows from the scatter of the segments before its own; only in the
        first segment, in which the design is still being calibrated, also from later ones.

    Raises
    ------
    ValueError
        There is no flight.
    """
    if flights.is_empty():
        raise ValueError(f"{component.model.name}: no flight to follow")
    rows, offset = flights.sort(IN_ORDER), offset or DesignOffset()
    losses = (_loss(rows, param, component, offset) for param in component.model.free("health"))
    return join_tracks(track_loss(rows, maintenance, loss, previous, seal) for loss in losses)


def _loss(flights: pl.DataFrame, param: Param, component: Component, offset: DesignOffset) -> Loss:
    """Build one parameter's loss from the flights' estimates."""
    size, settings = wear_settings(component, param, offset)
    estimates = flights.select(pl.when(~pl.col("status").is_in(WITHOUT_ESTIMATE)).then(param.name), f"{param.name}_sd")
    loss, loss_sd = estimates.to_numpy().astype(float).T
    wear, sd = (x / size for x in wear_of(loss, loss_sd, param))
    variance = np.where(np.isfinite(wear), sd**2 + scatter_by_segment(flights, wear, sd**2) ** 2, 1.0)
    status = pl.when(pl.Series(np.isfinite(wear))).then(pl.lit("ok")).otherwise(pl.lit("predicted"))
    observations = (-wear - offset.shift / size, variance, np.ones_like(wear))
    return Loss(component, param, size, settings, observations, status)


def wear_settings(component: Component, param: Param, offset: DesignOffset) -> tuple[float, Settings]:
    """Return the component's wear at failure over the exchanger's, and the filter's settings scaled by it."""
    size = _wear_at_failure(component, param) / _wear_at_failure(HX, HX.model.param(HX.loss))
    rate_ratio = HX.life_flights / component.life_flights
    factors = np.array([1.0, rate_ratio, rate_ratio, rate_ratio**1.5, rate_ratio**1.5])
    paces = tuple(Pace(*(factors * pace).tolist()) for pace in PACES)
    unit_sd = (UNIT_SD if param.unit_sd is None else param.unit_sd) / size
    walk, entries = param.drift / size or WEAR_STEP, _entries(component.new_share)
    washes = WASH_SHARE * (CLEANED in component.ended_by)
    return size, Settings(
        0.0, offset.sd / size, unit_sd, unit_sd, paces, walk, SUDDEN_LOSS, FAULT_CHANCE, washes, OFFSET_BIN, entries
    )


def _entries(new_share: float) -> tuple[EntryWear, ...]:
    """Return the exchanger's classes of units at entry with another share of new ones."""
    factor = (1.0 - new_share) / sum(e.share for e in ENTRY if not e.is_new)
    return tuple(e._replace(share=new_share if e.is_new else factor * e.share) for e in ENTRY)


def _wear_at_failure(component: Component, param: Param) -> float:
    return float(wear_of(np.array(component.limit.mean), np.array(0.0), param)[0])


def wear_of(loss: Array, sd: Array, param: Param) -> tuple[Array, Array]:
    """Convert a loss and its sd to wear, -ln(1 - loss), and its sd; a loss that can exceed 1 stays as it is."""
    return (-np.log1p(-loss), sd / (1.0 - loss)) if param.is_share else (loss, sd)


def scatter_by_segment(flights: pl.DataFrame, wear: Array, own_variance: Array, usual_sd: float | None = None) -> Array:
    """Estimate each flight's sd about its pack's health beyond its own, from the segments before: from no later flight.

    The first segment has `usual_sd`, or where that is not given the sd of its own flights.
    """
    scatter = np.empty(len(wear))
    for rows in split_packs(flights):
        for first in range(0, len(rows), SEGMENT_FLIGHTS):
            past = rows[: first or (SEGMENT_FLIGHTS if usual_sd is None else 0)]
            sd = scatter_sd(wear[past], own_variance[past], usual_sd or MIN_FLIGHT_SD)
            scatter[rows[first : first + SEGMENT_FLIGHTS]] = sd
    return scatter


def scatter_sd(wear: Array, own_variance: Array, usual_sd: float = MIN_FLIGHT_SD) -> float:
    """Estimate a flight's sd about its pack's health beyond its own from the steps between a pack's flights.

    `wear` is NaN where a flight has no estimate; `usual_sd` is the answer where steps are few.
    """
    has_wear = np.isfinite(wear)
    steps = np.diff(wear[has_wear])
    if len(steps) < LEAST_STEPS:
        return usual_sd
    excess_var = (MAD_TO_SD * np.median(np.abs(steps))) ** 2 / 2.0 - own_variance[has_wear].mean()
    return float(np.sqrt(max(excess_var, MIN_FLIGHT_SD**2)))


def flight_by_flight(
    samples: pl.DataFrame,
    model: PhysicsModel,
    free: Sequence[str],
    *,
    outputs: Sequence[str] | None = None,
    estimator: Estimator | None = None,
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

    Returns
    -------
    DataFrame
        One row a flight and pack of three samples or more, in order: `FLIGHT_PACK`, `departed_at`, a column and an
        `_sd` for each of `free`, `status`, `n_evals` (model evaluations).

    Notes
    -----
    Least squares starts every flight in the middle of the declared bounds, so that all are estimated side by side;
    another method, as the paper, at the last estimate that converged. Both end on the same optimum.
    """
    outputs = recorded_outputs(model, samples) if outputs is None else outputs
    order = flights_of(samples).select(*FLIGHT_PACK, "departed_at")
    complete = samples.drop_nulls([*(s.name for s in model.inputs), *outputs]).drop("departed_at", strict=False)
    complete = complete.filter(pl.len().over(FLIGHT_PACK) >= MIN_SAMPLES)
    complete = complete.join(order, on=FLIGHT_PACK, validate="m:1").sort(*IN_ORDER, "time_utc")
    start = np.array([model.param(name).bounds for name in free]).mean(axis=1)
    problem = samples_problem(complete, model, free, outputs, unknown(start))
    key = pl.struct(FLIGHT_PACK)
    problem = replace(problem, group=complete.select(key.rle_id().cast(pl.Int64))[:, 0].to_numpy())
    estimates = estimate_each(estimator or NonlinearLeastSquares(), problem) if complete.height else []
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
