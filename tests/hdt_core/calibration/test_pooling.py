"""Partial pooling against laws it must obey and truth it must cover."""

import numpy as np
import pytest

from hdt_core.calibration.pooling import pool


def drawn(seed: int, tau_operator: float, tau_pack: float, n: int = 60):
    rng = np.random.default_rng(seed)
    operator = np.arange(n) % 5
    operators = 2.0 + tau_operator * rng.standard_normal(5)
    packs = operators[operator] + tau_pack * rng.standard_normal(n)
    error = rng.uniform(0.02, 0.4, n)
    return packs + error * rng.standard_normal(n), error, operator, packs, operators


@pytest.mark.parametrize(("tau_operator", "tau_pack"), [(0.0, 0.1), (0.2, 0.1), (0.1, 0.3)])
def test_intervals_cover_and_pooling_beats_each_alone(tau_operator, tau_pack):
    covered, alone, pooled = [], [], []
    for seed in range(40):
        value, error, operator, packs, operators = drawn(seed, tau_operator, tau_pack)
        found = pool(value, error, operator)
        off, sd = np.r_[found.pack - packs, found.operator - operators], np.r_[found.pack_sd, found.operator_sd]
        covered.append(np.abs(off) < 1.645 * sd)
        alone.append(((value - packs) ** 2).mean())
        pooled.append(((found.pack - packs) ** 2).mean())
    assert 0.87 <= np.concatenate(covered).mean() <= 0.94
    assert np.mean(pooled) < 0.8 * np.mean(alone)


def test_pack_without_data_is_its_operator_and_one_with_much_is_itself():
    value, error, operator, _, _ = drawn(1, 0.1, 0.3)
    value[0], error[1] = np.nan, 1e-6
    found = pool(value, error, operator)
    assert found.pack[0] == pytest.approx(found.operator[operator[0]])
    assert found.pack_sd[0] > found.operator_sd[operator[0]]
    assert found.pack[1] == pytest.approx(value[1], abs=1e-4)


def test_shift_of_all_shifts_all():
    value, error, operator, _, _ = drawn(2, 0.1, 0.2)
    here, there = pool(value, error, operator), pool(value + 7.0, error, operator)
    np.testing.assert_allclose(there.pack, here.pack + 7.0, rtol=1e-9)
    assert there.fleet == pytest.approx(here.fleet + 7.0)
    assert there.fleet_sd == pytest.approx(here.fleet_sd)


def test_nothing_known_is_nan_not_an_error():
    found = pool(np.full(3, np.nan), np.ones(3), np.zeros(3, dtype=int))
    assert np.isnan(found.fleet)
    assert np.isnan(found.pack).all()
