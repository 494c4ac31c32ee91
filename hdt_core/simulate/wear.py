"""Wear of a heat exchanger over its life, as the fractional loss of conductance per flight.

The shapes are those of the fouling literature: linear deposit, asymptotic (Kern and Seaton 1959), falling rate
(diffusion or a log law), accelerating, jumps of a compound Poisson process on dusty stations, and sudden clogs.
No public per-flight series exists, so magnitudes are assumptions and spread widely on purpose.
"""

from dataclasses import dataclass

import numpy as np

from hdt_core.robust import Array

SHAPES = ("linear", "asymptotic", "falling_rate", "accelerating", "dusty_jumps")


@dataclass(frozen=True, slots=True)
class WearSettings:
    """How a population of units wears; one instance describes one kind of operation.

    Attributes
    ----------
    life_median_flights, life_log_sd : float
        Log-normal spread of the flights a unit takes to lose `reference_loss`. [flight], [-]
    reference_loss : float
        Loss that ends the nominal life. [-]
    shape_shares : tuple of float
        Share of each of `SHAPES`; need not sum to one.
    clog_rate : float
        Sudden clogs per flight. [1/flight]
    rate_log_sd : float
        Spread of the wear rate about its trend over blocks of 25 flights (routes, season). [-]
    """

    life_median_flights: float = 330.0
    life_log_sd: float = 0.75
    reference_loss: float = 0.42
    shape_shares: tuple[float, ...] = (0.22, 0.15, 0.13, 0.30, 0.20)
    clog_rate: float = 1.0 / 2500.0
    rate_log_sd: float = 0.25


@dataclass(frozen=True, slots=True)
class UnitWear:
    """Wear of units over flights, without maintenance.

    Attributes
    ----------
    loss : ndarray, shape (units, flights)
        Fractional loss of conductance before the maintenance log is applied. [-]
    shape : ndarray of str, shape (units,)
        Which of `SHAPES` the gradual part follows.
    clog : ndarray, shape (units, flights)
        The part of `loss` that came from sudden clogs. [-]
    """

    loss: Array
    shape: Array
    clog: Array


def draw_wear(rng: np.random.Generator, entry_age: Array, flights: int, settings: WearSettings) -> UnitWear:
    """Wear curves of units that enter with a given age.

    Parameters
    ----------
    rng : Generator
        Source of randomness; the same generator state gives the same lives.
    entry_age : array, shape (units,)
        Age at the first flight as a share of the nominal life, 0 for a new unit. [-]
    flights : int
        Flights to draw.
    settings : WearSettings
        Population the units are drawn from.

    Returns
    -------
    UnitWear
        Loss per unit and flight, never negative, at most 0.95.
    """
    units = entry_age.size
    shares = np.asarray(settings.shape_shares)
    kind = rng.choice(len(SHAPES), size=units, p=shares / shares.sum())
    life = settings.life_median_flights * np.exp(settings.life_log_sd * rng.standard_normal(units))
    age = entry_age[:, None] * life[:, None] + _operating_age(rng, units, flights, settings.rate_log_sd)
    gradual = _gradual(rng, kind, age, life, settings.reference_loss)
    clog = _clogs(rng, (units, flights), settings.clog_rate)
    loss = 1.0 - (1.0 - np.minimum(gradual, 0.9)) * (1.0 - clog)
    return UnitWear(np.minimum(loss, 0.95), np.asarray(SHAPES)[kind], clog)


def _operating_age(rng: np.random.Generator, units: int, flights: int, log_sd: float) -> Array:
    """Flights weighted by how hard they were: a block of 25 flights shares its routes and season."""
    blocks = np.exp(log_sd * rng.standard_normal((units, flights // 25 + 1)) - 0.5 * log_sd**2)
    rate = np.repeat(blocks, 25, axis=1)[:, :flights]
    return np.cumsum(rate * rng.gamma(2.0, 0.5, (units, flights)), axis=1)


def _gradual(rng: np.random.Generator, kind: Array, age: Array, life: Array, end: float) -> Array:
    """Loss by the unit's own shape; every shape is scaled so that it nears `end` at the nominal life."""
    share = age / life[:, None]
    units = kind.size
    power = rng.uniform(1.4, 3.2, units)[:, None]
    plateau = rng.uniform(0.4, 1.6, units)[:, None]
    tau = rng.uniform(0.25, 0.8, units)[:, None]
    root = rng.uniform(0.35, 0.7, units)[:, None]
    curves = (
        share,
        plateau * (1.0 - np.exp(-share / tau)),
        share**root,
        share**power,
        _jumps(rng, share),
    )
    return end * np.choose(kind[:, None], curves)


def _jumps(rng: np.random.Generator, share: Array) -> Array:
    """Draw compound Poisson wear with mean `share`: few large deposits, a slow creep between them."""
    per_life = np.exp(rng.uniform(np.log(2.0), np.log(20.0), (share.shape[0], 1)))
    creep = rng.uniform(0.0, 0.3, (share.shape[0], 1))
    step = np.asarray(np.diff(share, axis=1, prepend=np.zeros((share.shape[0], 1))))
    count = rng.poisson(step * per_life)
    # a sum of k exponential deposits is a gamma draw of shape k
    size = rng.gamma(np.maximum(count, 1e-9), 1.0 / per_life) * (count > 0)
    return np.asarray(creep * share + (1.0 - creep) * np.cumsum(size, axis=1))


def _clogs(rng: np.random.Generator, size: tuple[int, int], rate: float) -> Array:
    """Draw loss by bags, insects and debris: a step of 5 to 25 % that builds over 1 to 3 flights."""
    step = rng.uniform(0.05, 0.25, size) * (rng.random(size) < rate)
    daily_step = step / 3.0
    total = np.cumsum(daily_step + _delay(daily_step, 1) + _delay(daily_step, 2), axis=1)
    return np.minimum(total, 0.6)


def _delay(values: Array, flights: int) -> Array:
    out = np.zeros_like(values)
    out[:, flights:] = values[:, :-flights]
    return out
