"""Draw many small fleets of lives, each with its own type, climate, wear, message and twin, to fit a general model."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hdt_core.margin.margin import LN_RATIO_PER_K, MessageRule
from hdt_core.robust import Array
from hdt_core.simulate.episodes import LEAD, Episodes, EpisodeSettings, draw_episodes, draw_limited
from hdt_core.simulate.wear import WearSettings

LIMITED_SHARE = 0.15
"""Share of the fleets whose lives end at a limit of their own, as a compressor's do."""
UNLOGGED_SHARE = 0.2
"""Share of the others whose operator logs nothing, so that one life joins several units in a row."""


def draw_fleets(seed: int, fleets: int, aircraft: int, flights: int) -> Iterator[tuple[Episodes, float]]:
    """Draw fleets of lives with different habits.

    Parameters
    ----------
    seed : int
        Same seed, same fleets.
    fleets, aircraft, flights : int
        Fleets, aircraft a fleet (two units each), flights each unit is followed.

    Yields
    ------
    episodes : Episodes
        The lives.
    limit_sd : float
        Standard deviation of the message's assumed limit, in ln of conductance. [-]
    """
    rng = np.random.default_rng(seed)
    for number in range(fleets):
        settings = _draw_settings(rng, aircraft, flights)
        fleet_seed = seed * 1009 + number
        if rng.random() < LIMITED_SHARE:
            limit, limit_sd = float(np.clip(0.25 + 0.06 * rng.standard_normal(), 0.1, 0.5)), rng.uniform(0.01, 0.08)
            limit_estimate = float(np.clip(limit + limit_sd * rng.standard_normal(), 0.08, 0.6))
            yield draw_limited(fleet_seed, settings, limit, limit_estimate), limit_sd / (1.0 - limit)
        else:
            excess_sd_k = rng.uniform(0.4, 3.0)
            excess_estimate_k = settings.rule.excess_k + excess_sd_k * float(rng.standard_normal())
            lives = draw_episodes(fleet_seed, replace(settings, believed_excess_k=excess_estimate_k))
            is_logged = rng.random() >= UNLOGGED_SHARE
            yield lives if is_logged else join_unlogged_lives(rng, lives), LN_RATIO_PER_K * excess_sd_k


def join_unlogged_lives(rng: np.random.Generator, lives: Episodes) -> Episodes:
    """Join lives of packs whose replacements are not logged: a unit's record continues with the next unit's.

    The unit that failed flies one to nine flights more; then the next pack's unit, with its flights, takes its place.
    The message that counts is the next one.
    """
    units, flights = lives.loss.shape
    joint = np.minimum(lives.message + rng.integers(2, 10, units), flights)
    follower = np.roll(np.arange(units), -1)

    def splice(values: Array, lead: int = 0) -> Array:
        out = values.copy()
        for unit, start in enumerate(joint + lead):
            length = values.shape[1] - start
            out[unit, start:] = values[follower[unit], lead : lead + length]
        return out

    second = np.minimum(joint + lives.message[follower], flights)
    names = ("loss", "estimated_loss", "sd", "ratio", "overheat_k", "overheat_half_k", "full_open", "day")
    series = {name: splice(getattr(lives, name)) for name in names}
    unsure = np.zeros(units, dtype=bool)
    return replace(
        lives,
        **series,
        demand=splice(lives.demand, LEAD),
        message=second,
        first_message=lives.message,
        age_known=unsure,
    )


def _draw_settings(rng: np.random.Generator, aircraft: int, flights: int) -> EpisodeSettings:
    wear = WearSettings(
        life_median_flights=330.0 * float(np.exp(0.35 * rng.standard_normal())),
        life_log_sd=rng.uniform(0.5, 0.9),
        shape_shares=tuple(rng.dirichlet(6.0 * np.array([0.22, 0.15, 0.13, 0.30, 0.20]))),
        clog_rate=float(np.exp(rng.uniform(np.log(1 / 6000), np.log(1 / 1200)))),
        rate_log_sd=rng.uniform(0.1, 0.4),
    )
    of = int(rng.choice([1, 2, 3], p=[0.15, 0.15, 0.7]))
    return replace(
        EpisodeSettings(),
        aircraft=aircraft,
        flights=flights,
        wear=wear,
        rule=MessageRule(rng.uniform(0.1, 0.5), rng.uniform(3.0, 11.0), of=of),
        map_error=rng.uniform(0.01, 0.05),
        pack_error=rng.uniform(0.005, 0.03),
        worn_at_entry=rng.uniform(0.1, 0.6),
        wash_share=float(rng.choice([0.0, 0.5, 1.0])),
        noise_sd=rng.uniform(0.004, 0.02),
        drift_sd=rng.uniform(0.002, 0.012),
        offset_sd=rng.uniform(0.005, 0.03),
        rebased_share=rng.uniform(0.0, 0.6),
    )
