"""Many small fleets of lives, each with its own wear, limit and twin, so that a model learns what they share."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hdt_core.simulate.episodes import Episodes, EpisodeSettings, draw_episodes
from hdt_core.simulate.wear import WearSettings


def draw_fleets(seed: int, fleets: int, units: int, flights: int) -> Iterator[tuple[Episodes, float]]:
    """Fleets of lives with different habits.

    Parameters
    ----------
    seed : int
        Same seed, same fleets.
    fleets, units, flights : int
        Fleets, units a fleet, flights each unit is followed.

    Yields
    ------
    episodes : Episodes
        The lives.
    limit : float
        The fleet's mean loss at the message. [-]
    """
    rng = np.random.default_rng(seed)
    for number in range(fleets):
        settings = _draw_settings(rng, units, flights)
        yield draw_episodes(seed * 1009 + number, settings), settings.limit_mean


def _draw_settings(rng: np.random.Generator, units: int, flights: int) -> EpisodeSettings:
    wear = WearSettings(
        life_median_flights=330.0 * float(np.exp(0.35 * rng.standard_normal())),
        life_log_sd=rng.uniform(0.5, 0.9),
        shape_shares=tuple(rng.dirichlet(6.0 * np.array([0.22, 0.15, 0.13, 0.30, 0.20]))),
        clog_rate=float(np.exp(rng.uniform(np.log(1 / 6000), np.log(1 / 1200)))),
        rate_log_sd=rng.uniform(0.1, 0.4),
    )
    limit = float(np.clip(0.41 + 0.06 * rng.standard_normal(), 0.22, 0.6))
    return replace(
        EpisodeSettings(),
        units=units,
        flights=flights,
        wear=replace(wear, reference_loss=limit),
        limit_mean=limit,
        limit_sd=rng.uniform(0.015, 0.04),
        weather_sd=rng.uniform(0.005, 0.025),
        worn_at_entry=rng.uniform(0.1, 0.6),
        wash_share=float(rng.choice([0.0, 0.5, 1.0])),
        noise_sd=rng.uniform(0.004, 0.02),
        drift_sd=rng.uniform(0.002, 0.012),
        offset_sd=rng.uniform(0.003, 0.015),
        rebased_share=rng.uniform(0.0, 0.6),
        door_reach=rng.uniform(0.65, 1.05),
        door_spread=rng.uniform(0.06, 0.2),
    )
