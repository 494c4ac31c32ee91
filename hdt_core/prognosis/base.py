"""Fit the base of the prognosis to simulated lives; a night uses the shipped one and imports no simulation."""

from dataclasses import fields

import numpy as np
from sklearn.ensemble import HistGradientBoostingClassifier

from hdt_core.margin.first_passage import repeated_demand
from hdt_core.prognosis.feature_rows import FeatureRows
from hdt_core.prognosis.hazard import event_by, fit_hazard, hazards
from hdt_core.prognosis.history import RISES, Panel, feature_rows, record_rows
from hdt_core.prognosis.model import Prognosis
from hdt_core.prognosis.recalibrate import learn_levels
from hdt_core.simulate.episodes import LEAD, Episodes
from hdt_core.simulate.training import draw_fleets

MEMBERS = 3
"""Models in the base."""


def fit_base() -> Prognosis:
    """Fit the base to simulated lives alone; it is the same for every fleet."""
    members = tuple(fit_member(seed) for seed in range(MEMBERS))
    check = simulated_rows(MEMBERS, fleets=20)
    by = event_by(hazards(members, check.features))
    return Prognosis(members, learn_levels(by, check.remaining, check.failed, check.life, prior_lives=0.0))


def fit_member(seed: int, fleets: int = 50) -> HistGradientBoostingClassifier:
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
