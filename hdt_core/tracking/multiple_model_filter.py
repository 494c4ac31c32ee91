"""Multiple-model filter: hypotheses of what has happened to a pack, each a Kalman filter, weighted side by side.

A step in the conductance can be a clog, a new core, a wash, or a fault of door or sensor that will pass; flights to
come decide. So nothing is decided on the spot: a surprising flight branches the hypothesis, the log and later flights
weigh the branches, and what can't be told apart leaves a wide and honest belief. How worn a unit was when its records
began is such a question too. Hypotheses are kept flat, sorted by pack, so that one pack or a fleet advance by the same
code.

References
----------
.. [1] Y. Bar-Shalom, X. R. Li and T. Kirubarajan, Estimation with Applications to Tracking and Navigation, 2001,
   chapter 11.6.
"""

import numpy as np
from scipy.special import erfcx

from hdt_core.calibration.arrays import Array
from hdt_core.records.renewals import NOTHING
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
    MAP_SD,
    OTHER,
    RATE,
    SENSORS,
    UNIT,
    WEAR,
    Observation,
    Settings,
    at_reference,
    innovation,
    predict,
    update,
)

SURPRISE = 2.0
"""Standard deviations at which a flight opens other readings of what has happened."""
ASLEEP = 10**6
"""Flights since the renewal of a core that was not new when first seen."""


def start(n: int, settings: Settings) -> Hypotheses:
    """Hypotheses about n packs before any flight: every pace with every wear at entry."""
    kinds = [(i, j) for i in range(len(settings.paces)) for j in range(len(settings.entries))]
    k = len(kinds)
    mean, cov = np.zeros((k, 5)), np.zeros((k, 5, 5))
    weight, since = np.zeros(k), np.zeros(k, dtype=np.int64)
    for row, (i, j) in enumerate(kinds):
        pace, entry = settings.paces[i], settings.entries[j]
        weight[row] = np.log(pace.share * entry.share)
        mean[row, WEAR], cov[row, WEAR, WEAR] = entry.wear, entry.wear_sd**2
        mean[row, RATE], cov[row, RATE, RATE] = pace.rate, pace.rate_sd**2
        since[row] = 0 if entry.is_new else ASLEEP
    for i, sd in ((SENSORS, settings.sensors_sd), (UNIT, settings.unit_sd), (OTHER, MAP_SD)):
        cov[:, i, i] = sd**2
    none = np.zeros(k * n, dtype=bool)
    return Hypotheses(
        np.repeat(np.arange(n), k),
        np.tile(weight, n),
        np.tile(mean, (n, 1)),
        np.tile(cov, (n, 1, 1)),
        np.tile(np.array([i for i, _ in kinds]), n),
        np.tile(since, n),
        none,
        none.copy(),
        np.arange(k * n),
        np.ones((k * n, 5)),
    )


def step(hypotheses: Hypotheses, seen: Observation, settings: Settings) -> tuple[Hypotheses, Branching]:
    """Advance all packs by one flight; `seen` holds one entry a pack."""
    worn = np.bincount(hypotheses.pack, np.exp(hypotheses.log_weight) * hypotheses.mean[:, WEAR], len(seen.ratio))
    seen, since = at_reference(seen, worn), hypotheses.since + 1
    mean, cov = predict(hypotheses.mean, hypotheses.cov, hypotheses.pace, since, hypotheses.faulty, settings)
    lasting = hypotheses.log_weight + np.where(hypotheses.faulty, np.log1p(-CHANCE["fault_over"]), 0.0)
    came = {"parent": np.arange(len(since)), "keeps": np.ones_like(mean)}
    aged = hypotheses._replace(mean=mean, cov=cov, since=since, log_weight=lasting, **came)
    prior = apply_log(aged, seen.of(hypotheses.pack), settings)
    here = seen.of(prior.pack)
    residual, variance = innovation(prior.mean, prior.cov, here, settings.level)
    has = np.isfinite(here.ratio)
    surprised = has & (np.abs(residual) > SURPRISE * np.sqrt(variance))
    asked = has & (here.log_open > 0) & (prior.since > LATE_FLIGHTS)
    grown = prior
    if surprised.any() or asked.any():
        grown_by = branch_on_surprise(prior, residual, surprised, np.where(asked, here.log_open, NOTHING), settings)
        stays = prior._replace(log_weight=prior.log_weight + np.where(asked, np.log1p(-RENEWAL_LOGGED), 0.0))
        grown = join([stays, *grown_by])
    met = grown.at(np.argsort(grown.pack, kind="stable"))
    mean, cov, evidence = update(met.mean, met.cov, seen.of(met.pack), settings.level)
    told = normalise(met._replace(mean=mean, cov=cov, log_weight=met.log_weight + evidence))
    after, into = prune(told, settings.offset_bin)
    return after, Branching(met, into, np.exp(told.log_weight))


def wear_summary(hypotheses: Hypotheses, n: int) -> tuple[Array, Array]:
    """Mean and standard deviation of ln loss, of which nothing negative is possible, over the hypotheses. (n,) each"""
    weight = np.exp(hypotheses.log_weight)
    mean, variance = _above_zero(hypotheses.mean[:, WEAR], np.sqrt(hypotheses.cov[:, WEAR, WEAR]))
    middle = np.bincount(hypotheses.pack, weight * mean, n)
    spread = np.bincount(hypotheses.pack, weight * (variance + (mean - middle[hypotheses.pack]) ** 2), n)
    return middle, np.sqrt(spread)


def _above_zero(mean: Array, sd: Array) -> tuple[Array, Array]:
    """Mean and variance of a normal variable cut off below 0."""
    a = np.clip(mean / sd, -30.0, 30.0)
    ratio = np.sqrt(2.0 / np.pi) / erfcx(-a / np.sqrt(2.0))  # inverse Mills ratio
    return np.maximum(mean, -30.0 * sd) + sd * ratio, sd**2 * np.maximum(1.0 - a * ratio - ratio**2, 1e-3)
