"""Model of wear from flight to flight and its effect on the conductance ratio: one scalar observation a flight.

The state of a pack is wear (ln loss of conductance at the reference condition), its rate, the offset of its sensors,
that of its unit, and an offset that is not the core's: the model's slow error, or a fault while it lasts. Functions
take any number of states at once, those of `hdt_core.tracking.multiple_model_filter`.
"""

from typing import NamedTuple

import numpy as np

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.baseline_wear import ENTRY, EntryWear
from hdt_core.components.pack import HX
from hdt_core.estimation.kalman_step import Affine, compute_gain, predict_belief, update_belief
from hdt_core.estimation.problem import Belief
from hdt_core.physics.model import declared

WEAR, RATE, SENSORS, UNIT, OTHER = range(5)
UNIT_SD = declared(HX.model.param("hx_fouling").unit_sd)
"""Unit-to-unit spread of UA; the rest of the offset's spread belongs to the pack's sensors and stays when a unit
goes."""
LEAST_SENSORS_SD = 0.015


class Pace(NamedTuple):
    """A class of wear: share of lives, ln loss a flight as a life begins, its spread, and the rate's random walk."""

    share: float
    rate: float
    rate_sd: float
    rate_step: float
    early_rate_step: float


PACES = (
    Pace(0.45, 1.5e-4, 2e-4, 4e-5, 4e-5),
    Pace(0.45, 1.0e-3, 8e-4, 6e-5, 6e-5),
    Pace(0.10, 6.0e-3, 4e-3, 6e-5, 5e-4),
)
"""Hardly, steadily, and fast at first: films that level off, dusty starts."""
EARLY_FLIGHTS = 20.0
WEAR_STEP = 7e-4
MAP_SD, MAP_FLIGHTS = 0.005, 40.0
"""Slow error of the model itself: weather and season move along the map, which is not quite the duct's."""
CLOG, FAULT_CHANCE = (0.17, 0.17), 1 / 700
"""Ln loss of a sudden clog and its spread, of any size: from a leaf to a bag. Chance of a fault on a flight: each of
five sensors fails once in 3,500."""
FAULT_STEP = 0.005
"""A sensor that drifts does so within a hundred flights."""
OUTLIER_SHARE, OUTLIER_SD = 0.01, 0.3
"""Flights without information on the core: icing, a pack switched off, a spike that passed the filter."""
ROW = np.array([-1.0, 0.0, 1.0, 1.0, 1.0])
"""Derivative of the ratio at the reference condition by the state."""


class Settings(NamedTuple):
    """Settings of the filter: clean level of the digital system model (see `Dsm`), spread and wear of the units.

    `clog` is the ln loss of a sudden clog and its spread, `fault_chance` the chance of a fault of door or sensor on a
    flight. `wash_share` of work that the log lacks are washes, beside recoveries without any work. Hypotheses whose
    sensors' offsets differ by more than `offset_bin` are not merged. `truncated`: a loss below 0 is impossible, and the
    estimate is the mean above it.
    """

    level: float
    level_sd: float
    offset_sd: float
    unit_sd: float = UNIT_SD
    paces: tuple[Pace, ...] = PACES
    wear_step: float = WEAR_STEP
    clog: tuple[float, float] = CLOG
    fault_chance: float = FAULT_CHANCE
    wash_share: float = 0.0
    offset_bin: float = np.inf
    entries: tuple[EntryWear, ...] = ENTRY
    truncated: bool = True

    @property
    def sensors_sd(self) -> float:
        """Sd of a pack's offset common to all of its units: its sensors, and the clean level's own error."""
        sensor_var = max(self.offset_sd**2 - self.unit_sd**2, LEAST_SENSORS_SD**2)
        return float(np.sqrt(sensor_var + self.level_sd**2))


class Observation(NamedTuple):
    """Observations of n flights: ln ratio (NaN where none), its variance, and flags of the log. (n,)

    `exposure` is the clean conductance of the flight over that of the reference condition: see `at_reference`.
    `log_open` (a renewal is possible), `log_due` (it is due), `log_kept` (a log is kept): see `records.renewals`.
    `unchecked` is the share of the ratio's sensors that no other vouches for: see `sensor_shifts.Corrections`.
    """

    ratio: Array
    variance: Array
    exposure: Array
    log_open: Array
    log_due: Array
    log_kept: Array
    unchecked: Array

    def of(self, rows: Array | tuple[Array, Array]) -> "Observation":
        """Select observations by an index of the arrays."""
        return Observation(*(values[rows] for values in self))


def at_reference(flight: Observation, wear: Array) -> Observation:
    r"""Convert observations to the reference condition, for packs with about this much wear. (n,)

    Notes
    -----
    A deposit is a resistance in series: where flows and clean conductance are larger it takes a larger share, and the
    controller makes them larger the more there is of it. Wear L at the reference shows as

    .. math:: \ln\left[1 + (e^{L} - 1) \, UA / UA_0\right]

    All hypotheses of a pack share the correction: else a flight at another condition would seem to tell wear from
    offset, and the law is not known that well.
    """
    positive_wear = np.maximum(wear, 0.0)
    return flight._replace(ratio=flight.ratio + np.log1p(np.expm1(positive_wear) * flight.exposure) - positive_wear)


def transition(faulty: Array) -> Array:
    """Build the transition of one flight without events. (m, 5, 5)"""
    move = np.tile(np.eye(5), (len(faulty), 1, 1))
    move[:, WEAR, RATE], move[:, OTHER, OTHER] = 1.0, _keep(faulty)
    return move


def _keep(faulty: Array) -> Array:
    return np.where(faulty, 1.0, np.exp(-1.0 / MAP_FLIGHTS))


def predict(belief: Belief, pace: Array, since: Array, faulty: Array, settings: Settings) -> Belief:
    """Predict states one flight later. mean (m, 5), cov (m, 5, 5); the rest (m,)."""
    late, early = (
        np.array([getattr(p, name) for p in settings.paces])[pace] for name in ("rate_step", "early_rate_step")
    )
    change = late + (early - late) * np.exp(-np.minimum(since, 1e3) / EARLY_FLIGHTS)
    noise = np.zeros_like(belief.cov)
    noise[:, WEAR, WEAR] = settings.wear_step**2
    noise[:, RATE, RATE] = change**2
    noise[:, OTHER, OTHER] = np.where(faulty, FAULT_STEP**2, MAP_SD**2 * (1.0 - _keep(faulty) ** 2))
    return predict_belief(belief, Affine(transition(faulty), np.zeros(5), noise))


def observe(flight: Observation, level: float) -> Affine:
    """Build the model of the ratio that each state lets expect."""
    return Affine(ROW[None], np.array([level]), flight.variance[:, None, None])


def innovation(belief: Belief, flight: Observation, level: float) -> tuple[Array, Array]:
    """Compute the residual and its variance for each state, 0 without an observation. (m,) each"""
    expected = predict_belief(belief, observe(flight, level))
    residual = np.where(np.isfinite(flight.ratio), flight.ratio - expected.mean[:, 0], 0.0)
    return residual, expected.cov[:, 0, 0]


def update(belief: Belief, flight: Observation, level: float) -> tuple[Belief, Array]:
    """Update states by a flight that may be an outlier; return also its log likelihood.

    Notes
    -----
    With probability `OUTLIER_SHARE` a flight holds no information. Both cases are merged by their moments at once: a
    possible outlier leaves a wider posterior.
    """
    has_ratio = np.isfinite(flight.ratio)
    correction = compute_gain(belief, observe(flight, level), np.where(has_ratio, flight.ratio, level)[:, None])
    residual = correction.innovation[:, 0]
    variance = 1.0 / correction.precision[:, 0, 0]
    log_regular = np.log1p(-OUTLIER_SHARE) + log_normal(residual, variance)
    log_outlier = np.log(OUTLIER_SHARE) + log_normal(residual, variance + OUTLIER_SD**2)
    evidence = np.logaddexp(log_regular, log_outlier)
    use = np.where(has_ratio, np.exp(log_regular - evidence), 0.0)
    updated = update_belief(belief, correction)
    shift = updated.mean - belief.mean
    share = use[:, None, None]
    spread_of_means = share * (1.0 - share) * shift[:, :, None] * shift[:, None, :]
    cov = share * updated.cov + (1.0 - share) * belief.cov + spread_of_means
    return Belief(belief.mean + use[:, None] * shift, cov), np.where(has_ratio, evidence, 0.0)


def log_normal(residual: Array, variance: Array) -> Array:
    """Compute the log density of a normal variable about 0, without its constant. (m,)"""
    return np.asarray(-0.5 * (residual**2 / variance + np.log(variance)))
