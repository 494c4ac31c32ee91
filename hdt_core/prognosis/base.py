"""Fit the base of the prognosis to simulated lives of many small fleets, each with its own type, climate, wear, message
and twin; a night uses the shipped one and imports no simulation."""

from collections.abc import Iterator
from dataclasses import fields, replace
from typing import TYPE_CHECKING

import numpy as np

from hdt_core.margin.first_passage import repeated_demand
from hdt_core.margin.margin import LN_RATIO_PER_K, MessageRule
from hdt_core.prognosis.feature_rows import FeatureRows
from hdt_core.prognosis.hazard import event_by, fit_hazard, hazards
from hdt_core.prognosis.history import RISES, Panel, feature_rows, record_rows
from hdt_core.prognosis.model import Prognosis
from hdt_core.prognosis.recalibrate import learn_levels
from hdt_core.robust import Array
from hdt_core.simulate.episodes import LEAD, Episodes, EpisodeSettings, draw_episodes, draw_limited
from hdt_core.simulate.wear import WearSettings

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingClassifier

LIMITED_SHARE = 0.15
"""Share of the fleets whose lives end at a limit of their own, as a compressor's do."""
UNLOGGED_SHARE = 0.2
"""Share of the others whose operator logs nothing, so that one life joins several units in a row."""
MEMBERS = 3
"""Models in the base."""


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
            limit = float(np.clip(0.25 + 0.06 * rng.standard_normal(), 0.1, 0.5))
            limit_sd = rng.uniform(0.01, 0.08)
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


def fit_base() -> Prognosis:
    """Fit the base to simulated lives alone; it is the same for every fleet."""
    members = tuple(fit_member(seed) for seed in range(MEMBERS))
    check = simulated_rows(MEMBERS, fleets=20)
    by = event_by(hazards(members, check.features))
    return Prognosis(members, learn_levels(by, check.remaining, check.failed, check.life, prior_lives=0.0))


def fit_member(seed: int, fleets: int = 50) -> "HistGradientBoostingClassifier":
    """Fit one model of a base to its own simulated fleets."""
    rows = simulated_rows(seed, fleets)
    return fit_hazard(rows.features, rows.remaining, rows.failed, seed, (*RISES, 0))


def simulated_rows(
    seed: int, fleets: int = 50, aircraft: int = 20, flights: int = 600, stride: int = 20
) -> FeatureRows:
    """Simulate rows of lives, with demand as uncertain as in a fleet with few messages."""
    rng = np.random.default_rng(seed + 1)
    parts = []
    for number, (lives, rule_sd) in enumerate(draw_fleets(seed, fleets, aircraft, flights)):
        remaining, failed = lives.remaining()
        offset = rng.integers(0, stride, (remaining.shape[0], 1))
        is_sampled = (remaining >= 1) & ((np.arange(flights)[None, :] + offset) % stride == 0)
        unit, flight = np.nonzero(is_sampled)
        record = record_rows(_panel_of(lives), (unit, flight))
        features = feature_rows(record, repeated_demand(lives.demand), (unit, LEAD + flight))
        table = np.column_stack([features, np.full(unit.size, rule_sd)])
        life = number * remaining.shape[0] + unit
        parts.append(FeatureRows(table, remaining[is_sampled], failed[is_sampled], life))
    return FeatureRows(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(FeatureRows)))


def _panel_of(lives: Episodes) -> Panel:
    age = np.where(lives.age_known[:, None], np.arange(lives.loss.shape[1], dtype=float), np.nan)
    return Panel(
        lives.estimated_loss, lives.sd, age, lives.ratio,
        lives.overheat_k, lives.overheat_half_k, lives.full_open, lives.day,
    )  # fmt: skip
