"""A component that is all declaration: calibrated on nominal flights, then filtered along what each flight said.

What a new component needs beside its `PhysicsModel`: nothing. The estimators are those of every other model.
"""

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.estimation.ekf import ExtendedKalman
from hdt_core.estimation.estimate import Estimate, Estimator
from hdt_core.estimation.nls import NonlinearLeastSquares
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.physics.model import Param, PhysicsModel
from hdt_core.records.keys import IN_ORDER, LEG_AT, PACK
from hdt_core.robust import spread
from hdt_core.tracking.sequential import recorded_outputs, samples_problem

LEAST_STEPS = 8
"""Steps between flights from which their scatter can be told."""
STRAY_SD = 5.0
"""Standard deviations, of scatter and drift, from which one flight alone is not believed to be a step."""
FIRST = 5
"""Flights that are believed as they come."""
SAYS_NOTHING = ("diverged", "not_identifiable")


def calibrate_component(
    model: PhysicsModel, samples: pl.DataFrame, *, estimator: Estimator | None = None
) -> tuple[PhysicsModel, Estimate]:
    """Free the `design` parameters on nominal samples, health at its nominal value; a declared prior counts.

    Parameters
    ----------
    samples : DataFrame
        Columns named as the model's inputs and outputs.

    Returns
    -------
    PhysicsModel, Estimate
        The digital system model: the same declaration with what was found as its nominal values; and how it was found.
        Its status is `weakly_identifiable` where the nominal samples leave a design parameter open, which
        `Estimate.weak` names: health told at other flows or temperatures than theirs then rests on a guess.

    Raises
    ------
    ValueError
        The samples do not determine the design, or no finite answer was found.
    """
    free = [p.name for p in model.free("design")]
    solve = NonlinearLeastSquares() if estimator is None else estimator
    found = solve.estimate(samples_problem(samples, model, free, recorded_outputs(model, samples), design_prior(model)))
    if found.status in SAYS_NOTHING:
        raise ValueError(f"{model.name}: {', '.join(free)} from {samples.height} nominal samples: {found.status}")
    return model.calibrated(dict(zip(free, map(float, found.belief.mean), strict=True))), found


def design_prior(model: PhysicsModel) -> Belief | None:
    """What is believed of the design before any flight; nothing where the declaration does not say it of each."""
    free = model.free("design")
    sd = [p.sd for p in free if p.sd is not None]
    return Belief(np.array([p.nominal for p in free]), np.diag(np.square(sd))) if len(sd) == len(free) else None


def track_component(flights: pl.DataFrame, model: PhysicsModel, component: str) -> pl.DataFrame:
    """Health parameters of every flight as the catalog holds them, filtered along each pack.

    Parameters
    ----------
    flights : DataFrame
        Of `flight_by_flight` with the health parameters free. Where it has a column `life`, each life of a pack is
        filtered by itself.
    model : PhysicsModel
        Its declared drift is how far a parameter may move from one flight to the next.
    component : str
        Code of the component in the tables.

    Returns
    -------
    DataFrame
        Long form: `LEG_AT`, component, parameter, value, sd, unit, status, estimator. A flight counts as much as
        flights scatter; nothing is taken from later ones. One that departs by more than `STRAY_SD` is `unconfirmed`,
        and not believed until the next agrees with it.

    Raises
    ------
    ValueError
        There is no flight.
    """
    if flights.is_empty():
        raise ValueError(f"{model.name}: no flight to follow")
    life = [*PACK, *(c for c in ("life",) if c in flights.columns)]
    packs = flights.sort(IN_ORDER).partition_by(life, maintain_order=True)
    return pl.concat([_filtered(pack, p, component) for pack in packs for p in model.free("health")])


def _filtered(pack: pl.DataFrame, param: Param, component: str) -> pl.DataFrame:
    """One parameter of one pack: a random walk of the declared drift, seen once a flight."""
    said = ~pl.col("status").is_in(SAYS_NOTHING)
    told = pack.select(pl.when(said).then(param.name)).to_series().to_numpy().astype(float)
    sigma = _scatter(told, pack[f"{param.name}_sd"].to_numpy())
    seen = _confirmed(told, STRAY_SD * float(np.hypot(sigma, param.drift)))
    walk = Problem(
        names=(param.name,),
        bounds=np.array([param.bounds]),
        prior=unknown(np.array([param.nominal])),
        measured=seen[:, None],
        sigma=np.array([sigma]),
        observe=lambda _states, theta, _sample: theta,
        drift=np.array([param.drift]),
    )
    found = ExtendedKalman(smoother_passes=0).estimate(walk)
    path, path_sd = (np.full((pack.height, 1), np.nan) if p is None else p for p in (found.path, found.path_sd))
    return pack.select(
        *LEG_AT,
        pl.lit(component).alias("component"),
        pl.lit(param.name).alias("parameter"),
        pl.Series("value", path[:, 0]).fill_nan(None),
        pl.Series("sd", path_sd[:, 0]).fill_nan(None),
        pl.lit(param.unit).alias("unit"),
        pl.when(pl.Series(np.isfinite(seen)))
        .then(pl.lit("ok"))
        .when(said)
        .then(pl.lit("unconfirmed"))
        .otherwise(pl.lit("predicted"))
        .alias("status"),
        pl.lit("kalman_filtered").alias("estimator"),
    )


def _confirmed(seen: Array, jump: float) -> Array:
    """`seen` without strays: a flight that lies further off than `jump` counts once the next one agrees with it.

    The first few flights all count: there is nothing yet that one could depart from.
    """
    believed, doubted = np.nan, np.nan
    out = np.full(len(seen), np.nan)
    for n, k in enumerate(np.flatnonzero(np.isfinite(seen))):
        if n < FIRST or min(abs(seen[k] - believed), np.nan_to_num(abs(seen[k] - doubted), nan=np.inf)) <= jump:
            out[k], believed, doubted = seen[k], seen[k], np.nan
        else:
            doubted = seen[k]
    return out


def _scatter(seen: Array, sd: Array) -> float:
    """Standard deviation of one flight about the pack's health: what its steps show, at least what it says itself."""
    steps = np.abs(np.diff(seen[np.isfinite(seen)]))
    shown = spread(steps) / np.sqrt(2.0) if len(steps) >= LEAST_STEPS else 0.0
    return float(np.hypot(shown, np.median(sd[np.isfinite(sd)])))
