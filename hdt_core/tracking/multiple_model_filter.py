"""Multiple-model filter: hypotheses of what has happened to a pack, each a Kalman filter, weighted side by side.

A step in the conductance can be a clog, a new core, a wash, or a fault of door or sensor that will pass; only later
flights decide. So a surprising flight branches the hypothesis, the log and later flights weight the branches, and
causes that they cannot separate leave a wide posterior. The wear of a unit when its records begin is treated likewise.
Hypotheses are flat arrays sorted by pack, so that one pack or a fleet advance by the same code.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
   chapter 11.6.
"""

import numpy as np
from scipy.special import erfcx

from hdt_core.calibration.arrays import Array
from hdt_core.records.unit_index import NOTHING
from hdt_core.tracking.hypotheses import (
    CHANCE,
    LATE_FLIGHTS,
    RENEWAL_LOGGED,
    Branching,
    Hypotheses,
    apply_log,
    branch_on_surprise,
    join,
    normalise,
    prune,
)
from hdt_core.tracking.wear_model import (
    WEAR,
    Observation,
    Settings,
    at_reference,
    innovation,
    predict,
    transition,
    update,
)

SURPRISE = 2.0
"""Standard deviations at which a flight branches the hypotheses."""


def step(hypotheses: Hypotheses, flight: Observation, settings: Settings) -> tuple[Hypotheses, Branching]:
    """Advance all packs by one flight; `flight` holds one entry a pack."""
    wear = np.bincount(hypotheses.pack, np.exp(hypotheses.log_weight) * hypotheses.mean[:, WEAR], len(flight.ratio))
    flight, since = at_reference(flight, wear), hypotheses.since + 1
    belief = predict(hypotheses.belief, hypotheses.pace, since, hypotheses.faulty, settings)
    log_weight = hypotheses.log_weight + np.where(hypotheses.faulty, np.log1p(-CHANCE["fault_over"]), 0.0)
    identity = {"parent": np.arange(len(since)), "retention": np.ones_like(belief.mean)}
    prior = hypotheses._replace(mean=belief.mean, cov=belief.cov, since=since, log_weight=log_weight, **identity)
    prior = apply_log(prior, flight.of(hypotheses.pack), settings)
    observations = flight.of(prior.pack)
    residual, variance = innovation(prior.belief, observations, settings.level)
    has_ratio = np.isfinite(observations.ratio)
    is_surprising = has_ratio & (np.abs(residual) > SURPRISE * np.sqrt(variance))
    has_entry = has_ratio & (observations.log_open > 0) & (prior.since > LATE_FLIGHTS)
    branches = prior
    if is_surprising.any() or has_entry.any():
        log_entry = np.where(has_entry, observations.log_open, NOTHING)
        stays = prior._replace(log_weight=prior.log_weight + np.where(has_entry, np.log1p(-RENEWAL_LOGGED), 0.0))
        branches = join(
            [stays, *branch_on_surprise(prior, residual, is_surprising, log_entry, observations.unchecked, settings)]
        )
    branches = branches.at(np.argsort(branches.pack, kind="stable"))
    belief, evidence = update(branches.belief, flight.of(branches.pack), settings.level)
    log_weight = branches.log_weight + evidence
    posterior = normalise(branches._replace(mean=belief.mean, cov=belief.cov, log_weight=log_weight))
    survivors, new_row = prune(posterior, settings.offset_bin)
    return survivors, _branching(hypotheses, branches, np.exp(posterior.log_weight), new_row)


def _branching(parents: Hypotheses, branches: Hypotheses, weight: Array, new_row: Array) -> Branching:
    """Collect what the smoother needs of the branches that were not dropped."""
    live = np.flatnonzero(new_row >= 0)
    branch = branches.at(live)
    move = branch.retention[:, :, None] * transition(parents.faulty[branch.parent])
    gain = np.linalg.solve(branch.cov, move @ parents.cov[branch.parent]).mT
    return Branching(branch.mean, branch.cov, branch.parent, new_row[live], weight[live], gain)


def wear_summary(hypotheses: Hypotheses, n: int, *, truncated: bool = True) -> tuple[Array, Array]:
    """Compute mean and sd of ln loss over the hypotheses of n packs; `truncated` below 0 or not. (n,) each"""
    weight = np.exp(hypotheses.log_weight)
    mean, variance = hypotheses.mean[:, WEAR], hypotheses.cov[:, WEAR, WEAR]
    if truncated:
        mean, variance = _above_zero(mean, np.sqrt(variance))
    middle = np.bincount(hypotheses.pack, weight * mean, n)
    variance_of_all = np.bincount(hypotheses.pack, weight * (variance + (mean - middle[hypotheses.pack]) ** 2), n)
    return middle, np.sqrt(variance_of_all)


def _above_zero(mean: Array, sd: Array) -> tuple[Array, Array]:
    """Compute mean and variance of a normal variable truncated below 0."""
    a = np.clip(mean / sd, -30.0, 30.0)
    ratio = np.sqrt(2.0 / np.pi) / erfcx(-a / np.sqrt(2.0))  # inverse Mills ratio
    return np.maximum(mean, -30.0 * sd) + sd * ratio, sd**2 * np.maximum(1.0 - a * ratio - ratio**2, 1e-3)
