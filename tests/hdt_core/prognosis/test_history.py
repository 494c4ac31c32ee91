"""Features are what they are called, and know nothing of the future."""

from dataclasses import fields

import numpy as np
import pytest

from hdt_core.prognosis.history import FEATURES, RISES, UNITS_AT_ONCE, Panel, feature_rows, record_rows

NAMES = {name: i for i, name in enumerate(FEATURES)}


def track(rows: int = 3, flights: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.cumsum(0.002 * rng.gamma(1.0, 1.0, (rows, flights)), axis=1) + 0.01 * rng.standard_normal((rows, flights))


def features(level: np.ndarray, demand: np.ndarray | None = None) -> dict[str, np.ndarray]:
    """Each feature over (units, flights), each unit on a pack of its own."""
    age = np.broadcast_to(np.arange(level.shape[1], dtype=float), level.shape)
    hot = 10.0 * np.clip(level, 0.0, 1.0)
    panel = Panel(
        level, np.full_like(level, 0.02), age, np.log1p(-np.clip(level, 0.0, 0.9)), hot, 0.5 * hot, 0.1 * hot, age
    )
    rng = np.random.default_rng(5)
    demand = -0.6 + 0.1 * rng.standard_normal((len(level), 400))[:, : level.shape[1]] if demand is None else demand
    at = tuple(i.ravel() for i in np.indices(level.shape))
    table = feature_rows(record_rows(panel, at), demand, at)
    return {name: table[:, i].reshape(level.shape) for name, i in NAMES.items()}


@pytest.mark.parametrize("cut", [1, 6, 50, 150])
def test_nothing_from_the_future(cut):
    level = track()
    whole, early = features(level), features(level[:, :cut])
    for name in FEATURES:
        np.testing.assert_allclose(whole[name][:, :cut], early[name], atol=1e-9, err_msg=name)


def test_what_is_asked_beyond_what_is_left_is_a_message_soon():
    level = np.broadcast_to(0.1 + 0.002 * np.arange(150.0), (1, 150))
    safe, failing = (features(level, np.full((1, 150), np.log(share))) for share in (0.2, 0.9))
    assert safe["passage_50"][0, 140] < 0.01
    assert failing["passage_50"][0, 140] > 0.99
    assert failing["passage_median"][0, 140] < 10.0 < safe["passage_median"][0, 140]


def test_the_hazard_may_only_follow_physics_where_physics_says_how():
    signs = dict(zip(FEATURES, RISES, strict=True))
    assert signs["reserve_95"] == signs["left_linear_30"] == signs["passage_median"] == -1
    assert signs["passage_100"] == signs["overheat_40"] == signs["hot_share_40"] == 1
    assert signs["level"] == signs["slope_30"] == 0


def test_what_a_unit_shows_does_not_hang_on_who_flies_beside_it():
    """However many units are looked at together, to the last digit."""
    level = track(2 * UNITS_AT_ONCE + 3, 40)
    panel = Panel(level, *(np.full_like(level, k) for k in (0.02, 10.0, -0.3, 2.0, 1.0, 0.2, 100.0)))
    unit, flight = (i.ravel() for i in np.indices(level.shape))
    mixed = np.random.default_rng(1).permutation(unit.size)
    together = record_rows(panel, (unit[mixed], flight[mixed]))
    for k in (0, UNITS_AT_ONCE - 1, UNITS_AT_ONCE, len(level) - 1):
        alone = Panel(*(getattr(panel, f.name)[k : k + 1] for f in fields(Panel)))
        own = unit[mixed] == k
        np.testing.assert_array_equal(together[own], record_rows(alone, (np.zeros(own.sum(), int), flight[mixed][own])))
