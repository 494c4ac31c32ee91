"""Unit lives as the twin would see them: the training episodes of the prognosis model.

A life is a wear curve, washed now and then, watched through the twin's noise, and ended by the message the aircraft
raises when its temperature controller runs out of ram door. At which loss that happens varies with weather, route and
unit, so the hazard rises steeply with the loss instead of jumping at one value.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hdt_core.simulate.wear import Array, WearSettings, draw_wear


@dataclass(frozen=True, slots=True)
class EpisodeSettings:
    """A fleet of lives to learn from.

    Attributes
    ----------
    units, flights : int
        Lives drawn, and how long each is followed. [-], [flight]
    wear : WearSettings
        Population of wear.
    limit_mean, limit_sd : float
        Loss at which the controller gives up on a normal day, and its spread over units. [-]
    weather_sd : float
        Spread of that limit over flights: hot days and slow routes raise the message earlier. [-]
    worn_at_entry : float
        Share of units that were flying before the record begins. [-]
    wash_share, wash_every_flights : float
        Share of units washed on schedule, and mean flights between washes. [-], [flight]
    noise_sd, drift_sd, offset_sd : float
        The twin's error: per flight, slowly varying, and constant for a unit. [-]
    rebased_share : float
        Share of the units worn at entry whose wear the twin took for its own zero, in part. [-]
    door_reach, door_spread : float
        Share of the limit at which the ram door stands full open half of the time, and over what range of loss (a share
        of the limit) that comes about. [-]
    """

    units: int = 1500
    flights: int = 600
    wear: WearSettings = field(default_factory=WearSettings)
    limit_mean: float = 0.42
    limit_sd: float = 0.03
    weather_sd: float = 0.015
    worn_at_entry: float = 0.3
    wash_share: float = 0.4
    wash_every_flights: float = 250.0
    noise_sd: float = 0.012
    drift_sd: float = 0.008
    offset_sd: float = 0.008
    rebased_share: float = 0.4
    door_reach: float = 0.85
    door_spread: float = 0.12


@dataclass(frozen=True, slots=True)
class Episodes:
    """Lives with known ends.

    Attributes
    ----------
    loss, measured, sd : ndarray, shape (units, flights)
        True loss, the twin's filtered loss and its stated standard deviation. [-]
    full_open : ndarray, shape (units, flights)
        Share of each flight's cruise with the ram door full open. [-]
    message : ndarray of int, shape (units,)
        Flight of the message, `flights` when none came while the unit was followed.
    age_known : ndarray of bool, shape (units,)
        False for a unit that was already flying when the record began.
    """

    loss: Array
    measured: Array
    sd: Array
    full_open: Array
    message: NDArray[np.int_]
    age_known: NDArray[np.bool_]


def draw_episodes(seed: int, settings: EpisodeSettings) -> Episodes:
    """Lives from installation or entry to the message, or to the end of the record.

    Parameters
    ----------
    seed : int
        Same seed and settings, same lives.
    settings : EpisodeSettings
        The fleet to draw.
    """
    rng = np.random.default_rng(seed)
    old = rng.random(settings.units) < settings.worn_at_entry
    wear = draw_wear(rng, np.where(old, rng.uniform(0.0, 0.7, settings.units), 0.0), settings.flights, settings.wear)
    loss = _wash(rng, wear.loss, settings)
    limit = settings.limit_mean + settings.limit_sd * rng.standard_normal((settings.units, 1))
    message = _message(rng, loss, limit, settings)
    age_known = ~old & (rng.random(settings.units) < 0.7)
    measured, sd = _observe(rng, loss, settings, age_known)
    # nobody saw the unit new: what it had lost by entry can be missing from all that is said of it
    rebased = old & (rng.random(settings.units) < settings.rebased_share)
    measured -= (rebased * rng.uniform(0.0, 0.9, settings.units) * loss[:, 0])[:, None]
    return Episodes(loss, measured, sd, _full_open(rng, loss, limit, settings), message, age_known)


def _wash(rng: np.random.Generator, loss: Array, settings: EpisodeSettings) -> Array:
    """Scheduled washes: each takes away a part of what had been deposited by then."""
    units, flights = loss.shape
    washed = rng.random((units, 1)) < settings.wash_share
    due = (rng.random(loss.shape) < 1.0 / settings.wash_every_flights) & washed
    left = rng.uniform(0.1, 0.6, loss.shape)
    step = np.asarray(np.diff(loss, axis=1, prepend=np.zeros((units, 1))))
    out = np.empty_like(loss)
    level = np.zeros(units)
    for k in range(flights):
        level = np.where(due[:, k], level * left[:, k], level) + step[:, k]
        out[:, k] = level
    return out


def _message(rng: np.random.Generator, loss: Array, limit: Array, settings: EpisodeSettings) -> NDArray[np.int_]:
    """First flight on which the loss exceeds what that day's weather leaves room for."""
    units, flights = loss.shape
    season = np.sin(2.0 * np.pi * (np.arange(flights) / 1400.0 + rng.random((units, 1))))
    day = settings.weather_sd * (season + rng.standard_normal(loss.shape))
    over = loss + day > limit
    return np.asarray(np.where(over.any(axis=1), over.argmax(axis=1), flights))


def _full_open(rng: np.random.Generator, loss: Array, limit: Array, settings: EpisodeSettings) -> Array:
    """The controller's side of it: on a hard flight the door is full open at a smaller loss than on an easy one."""
    unit = 1.0 + 0.05 * rng.standard_normal(limit.shape)
    flight = settings.door_spread * rng.standard_normal(loss.shape)
    short = (loss / limit - settings.door_reach * unit + flight) / (0.4 * settings.door_spread)
    share = 1.0 / (1.0 + np.exp(-np.clip(1.7 * short, -30.0, 30.0)))
    # a share of some twenty snapshots
    return np.asarray(rng.binomial(20, share) / 20.0)


def _observe(
    rng: np.random.Generator, loss: Array, settings: EpisodeSettings, age_known: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Measured loss as a filter returns it: noisy flights, smoothed with a unit's own gain, plus slow errors."""
    units, flights = loss.shape
    offset = settings.offset_sd * np.where(age_known, 1.0, 2.0) * rng.standard_normal(units)
    gain = rng.uniform(0.15, 0.6, units)
    flight = loss + settings.noise_sd * rng.standard_normal(loss.shape)
    measured = np.empty_like(loss)
    level, drift = flight[:, 0], settings.drift_sd * rng.standard_normal(units)
    for k in range(flights):
        surprise = flight[:, k] - level
        # the twin's filter opens up for a clear step, so a clog isn't smeared over weeks
        level = level + np.where(np.abs(surprise) > 4.0 * settings.noise_sd, 0.9, gain) * surprise
        drift = 0.98 * drift + np.sqrt(1.0 - 0.98**2) * settings.drift_sd * rng.standard_normal(units)
        measured[:, k] = level + offset + drift
    spread = np.sqrt(offset.std() ** 2 + settings.drift_sd**2 + (settings.noise_sd * 0.5) ** 2)
    return measured, spread * rng.uniform(0.7, 1.4, (units, 1)) * np.ones_like(loss)
