"""Simulate unit lives as the twin would estimate them: training episodes of the prognosis model.

A life is a wear curve with washes, observed with the twin's noise, and ended by the message that the aircraft raises
when demand exceeds the remaining conductance (`hdt_core.simulate.margins`). A compressor's ends
where its loss passes a limit that varies from unit to unit and day to day.
"""

from dataclasses import dataclass, field

import numpy as np

from hdt_core.margin.margin import MessageRule
from hdt_core.robust import Array
from hdt_core.simulate.margins import OutletExcess, critical_ratio, draw_demand, excess_at
from hdt_core.simulate.wear import WearSettings, draw_wear

LEAD = 150
"""Flights of the pack before the unit was installed, whose demand is known."""


@dataclass(frozen=True, slots=True)
class EpisodeSettings:
    """A fleet of lives to learn from.

    Attributes
    ----------
    aircraft, flights : int
        Aircraft of two packs each, and how long each life is followed. [-], [flight]
    wear : WearSettings
        Population of wear.
    rule : MessageRule
        When the message comes.
    believed_excess_k : float
        Assumed excess of the rule. [K]
    map_error, pack_error : float
        Standard deviation over fleets, and over packs, of the error of a flight's demand. ln [-]
    unit_sd : float
        Spread of conductance over units as built. ln [-]
    worn_at_entry : float
        Share of units that were flying before the record begins. [-]
    wash_share, wash_every_flights : float
        Share of units washed on schedule, and mean flights between washes. [-], [flight]
    noise_sd, drift_sd, offset_sd : float
        The twin's error: per flight, slowly varying, and constant for a unit. [-]
    rebased_share : float
        Share of the units worn at entry whose wear the twin took for its own zero, in part. [-]
    """

    aircraft: int = 20
    flights: int = 600
    wear: WearSettings = field(default_factory=WearSettings)
    rule: MessageRule = field(default_factory=MessageRule)
    believed_excess_k: float = 7.0
    map_error: float = 0.03
    pack_error: float = 0.02
    unit_sd: float = 0.04
    worn_at_entry: float = 0.3
    wash_share: float = 0.4
    wash_every_flights: float = 250.0
    noise_sd: float = 0.012
    drift_sd: float = 0.008
    offset_sd: float = 0.02
    rebased_share: float = 0.4


@dataclass(frozen=True, slots=True)
class Episodes:
    """Lives with known ends; arrays are (units, flights) by default.

    Attributes
    ----------
    loss, estimated_loss, sd : ndarray
        True loss, the twin's filtered loss and its stated standard deviation. [-]
    ratio : ndarray
        The twin's filtered ln conductance ratio. [-]
    demand : ndarray, shape (units, LEAD + flights)
        Estimated critical ln ratio of each flight, NaN before the record begins. [-]
    overheat_k, overheat_half_k, full_open : ndarray
        How far the outlet was above its level in the hottest fifth and in half of the high samples [K], and share of
        them with the ram door full open [-]; NaN for a compressor.
    day : ndarray
        Day of the year and years before. [day]
    message : ndarray of int, shape (units,)
        Flight of the message, `flights` when none came while the unit was followed.
    age_known : ndarray of bool, shape (units,)
        False for a unit that was already flying when the record began.
    first_message : ndarray of int, shape (units,), optional
        Flight of an earlier unit's message, where no log cut the lives apart.
    """

    loss: Array
    estimated_loss: Array
    sd: Array
    ratio: Array
    demand: Array
    overheat_k: Array
    overheat_half_k: Array
    full_open: Array
    day: Array
    message: Array
    age_known: Array
    first_message: Array | None = None

    def remaining(self) -> tuple[Array, Array]:
        """Compute flights to the next message or the record's end, and whether it is a message. (units, flights)"""
        k = np.arange(self.loss.shape[1])[None, :]
        end = np.broadcast_to(self.message[:, None], self.loss.shape)
        if self.first_message is not None:
            end = np.where(k < self.first_message[:, None], self.first_message[:, None], end)
        return (end - k).astype(float), np.asarray(end < self.loss.shape[1])


def draw_episodes(seed: int, settings: EpisodeSettings) -> Episodes:
    """Draw lives of exchangers from installation or entry to the message, or to the end of the record.

    Parameters
    ----------
    seed : int
        Same seed and settings, same lives.
    settings : EpisodeSettings
        The fleet to draw.
    """
    rng = np.random.default_rng(seed)
    flights = draw_demand(rng, settings.aircraft, LEAD + settings.flights)
    units = flights.day.shape[0]
    is_worn, loss = _losses(rng, units, settings)
    unit_offset = settings.unit_sd * rng.standard_normal((units, 1))
    ln_ratio = unit_offset + np.log1p(-loss)
    excess_k = excess_at(flights.skip(LEAD), ln_ratio)
    message = _message(excess_k, settings.rule)
    age_known = ~is_worn & (rng.random(units) < 0.7)
    estimates = _observe(rng, loss, settings, is_worn, age_known)
    hot = np.quantile(excess_k, [0.5, 0.8], axis=2)
    return Episodes(
        loss=loss,
        estimated_loss=estimates[0],
        sd=estimates[1],
        ratio=unit_offset + estimates[2],
        demand=_estimate_demand(rng, flights, is_worn, settings),
        overheat_k=np.maximum(hot[1], 0.0),
        overheat_half_k=np.maximum(hot[0], 0.0),
        full_open=np.asarray((excess_k > -0.5).mean(axis=2)),
        day=flights.day[:, LEAD:],
        message=message,
        age_known=age_known,
    )


def draw_limited(seed: int, settings: EpisodeSettings, limit: float, estimate: float) -> Episodes:
    """Draw lives of compressors: the message comes where the loss passes a limit, `limit` in the mean of the fleet.

    Parameters
    ----------
    seed, settings
        As in `draw_episodes`.
    limit, estimate : float
        Mean loss at the message, and its estimate. [-]
    """
    rng = np.random.default_rng(seed)
    units = 2 * settings.aircraft
    is_worn, loss = _losses(rng, units, settings)
    unit_limit = limit + 0.03 * rng.standard_normal((units, 1))
    over = loss + 0.012 * rng.standard_normal(loss.shape) > unit_limit
    age_known = ~is_worn & (rng.random(units) < 0.7)
    estimates = _observe(rng, loss, settings, is_worn, age_known)
    nothing = np.full(loss.shape, np.nan)
    return Episodes(
        loss=loss, estimated_loss=estimates[0], sd=estimates[1], ratio=np.log1p(-np.minimum(estimates[0], 0.95)),
        demand=np.full((units, LEAD + settings.flights), np.log1p(-estimate)),
        overheat_k=nothing, overheat_half_k=nothing, full_open=nothing, day=nothing,
        message=np.asarray(np.where(over.any(axis=1), over.argmax(axis=1), settings.flights)), age_known=age_known,
    )  # fmt: skip


def _losses(rng: np.random.Generator, units: int, settings: EpisodeSettings) -> tuple[Array, Array]:
    """Draw which units are worn at entry, (units,), and the loss of each, (units, flights)."""
    is_worn = np.asarray(rng.random(units) < settings.worn_at_entry)
    age = np.where(is_worn, rng.uniform(0.0, 0.7, units), 0.0)
    return is_worn, np.minimum(_wash(rng, draw_wear(rng, age, settings.flights, settings.wear).loss, settings), 0.9)


def _wash(rng: np.random.Generator, loss: Array, settings: EpisodeSettings) -> Array:
    """Apply scheduled washes: each removes a part of the deposit."""
    units, flights = loss.shape
    is_washed = rng.random((units, 1)) < settings.wash_share
    due = (rng.random(loss.shape) < 1.0 / settings.wash_every_flights) & is_washed
    remaining_share = rng.uniform(0.1, 0.6, loss.shape)
    step = np.asarray(np.diff(loss, axis=1, prepend=np.zeros((units, 1))))
    out = np.empty_like(loss)
    level = np.zeros(units)
    for k in range(flights):
        level = np.where(due[:, k], level * remaining_share[:, k], level) + step[:, k]
        out[:, k] = level
    return out


def _message(excess_k: Array, rule: MessageRule) -> Array:
    """Find the first flight on which the rule is met; `flights` where it never is."""
    hot = np.quantile(excess_k, 1.0 - rule.share, axis=2) > rule.excess_k
    is_repeat = np.zeros_like(hot)
    for lag in range(1, rule.of):
        is_repeat[:, lag:] |= hot[:, :-lag]
    is_met = hot & (is_repeat if rule.of > 1 else True)
    return np.asarray(np.where(is_met.any(axis=1), is_met.argmax(axis=1), hot.shape[1]))


def _estimate_demand(
    rng: np.random.Generator, flights: OutletExcess, is_worn: Array, settings: EpisodeSettings
) -> Array:
    """Simulate the estimate of each flight's demand: by an uncertain rule, through a model with errors."""
    critical = critical_ratio(flights, 0.2, settings.believed_excess_k)
    error = settings.map_error * rng.standard_normal() + settings.pack_error * rng.standard_normal((is_worn.size, 1))
    flight = 0.015 * rng.standard_normal(critical.shape)
    known_from = np.where(is_worn, LEAD, rng.integers(0, LEAD, is_worn.size))
    nothing = np.arange(critical.shape[1])[None, :] < known_from[:, None]
    return np.where(nothing, np.nan, critical + error + flight)


def _observe(
    rng: np.random.Generator,
    loss: Array,
    settings: EpisodeSettings,
    is_worn: Array,
    age_known: Array,
) -> tuple[Array, Array, Array]:
    """Simulate a filter's loss, stated sd and ln ratio: noisy flights smoothed with a unit's own gain, slow errors; the
    loss with the offset of its zero as well.
    """
    units = loss.shape[0]
    offset = settings.offset_sd * np.where(age_known, 0.5, 1.0) * rng.standard_normal(units)
    gain = rng.uniform(0.15, 0.6, units)
    flight = loss + settings.noise_sd * rng.standard_normal(loss.shape)
    filtered = np.empty_like(loss)
    level = flight[:, 0]
    drift = settings.drift_sd * rng.standard_normal(units)
    for k in range(loss.shape[1]):
        innovation = flight[:, k] - level
        # the twin's filter raises its gain at a clear step, so a clog isn't smeared over weeks
        level = level + np.where(np.abs(innovation) > 4.0 * settings.noise_sd, 0.9, gain) * innovation
        drift = 0.98 * drift + np.sqrt(1.0 - 0.98**2) * settings.drift_sd * rng.standard_normal(units)
        filtered[:, k] = level + drift
    # the unit was not recorded when new: its loss at entry can be missing from every estimate
    is_rebased = is_worn & (rng.random(units) < settings.rebased_share)
    missing = (is_rebased * rng.uniform(0.0, 0.9, units) * loss[:, 0])[:, None]
    sd_unit = np.sqrt(settings.offset_sd**2 + settings.drift_sd**2 + (settings.noise_sd * 0.5) ** 2)
    sd = sd_unit * rng.uniform(0.7, 1.4, (units, 1)) * np.ones_like(loss)
    return filtered + offset[:, None] - missing, sd, np.log1p(-np.minimum(filtered, 0.95))
