"""Partial pooling against the normal-normal posterior by dense matrices, on the same grid of spreads."""

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration.pooling import levels_of, pool

GRID = (0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4)


def by_matrices(value, error, operator) -> np.ndarray:
    """Mean and sd of fleet, operators and packs: a very wide prior on the fleet's mean, a flat one on the spreads."""
    finite, n = np.isfinite(value), int(operator.max()) + 1
    unit, design = max(np.std(value[finite]), np.median(error[finite])), np.eye(n)[operator]
    moments, logs = [], []
    for a in GRID if n > 1 else [0.0]:
        for b in GRID[1:]:
            # fleet, operators, packs from the fleet's mean, operators' and packs' deviations
            to = np.block([
                [np.ones((1, 1)), np.zeros((1, n + len(value)))],
                [np.ones((n, 1)), np.eye(n), np.zeros((n, len(value)))],
                [np.ones((len(value), 1)), design, np.eye(len(value))],
            ])  # fmt: skip
            cov = np.diag(np.r_[1e5 * unit**2, [(a * unit) ** 2] * n, [(b * unit) ** 2] * len(value)])
            cov, rows = to @ cov @ to.T, 1 + n + np.flatnonzero(finite)
            noise = cov[np.ix_(rows, rows)] + np.diag(error[finite] ** 2)
            gain = cov[:, rows] @ np.linalg.inv(noise)
            moments.append((gain @ value[finite], np.diag(cov - gain @ cov[rows])))
            residual = value[finite] @ np.linalg.solve(noise, value[finite])
            logs.append(-0.5 * (np.linalg.slogdet(noise)[1] + residual))
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    means, variances = (np.array(m) for m in zip(*moments, strict=True))
    mean = weight @ means
    return np.array([mean, np.sqrt(weight @ (variances + (means - mean) ** 2))])


def draw_packs(n_operators: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    operator = np.arange(9) % n_operators
    value = 0.1 * rng.standard_normal(n_operators)[operator] + 0.05 * rng.standard_normal(9)
    value[4] = np.nan
    return value, rng.uniform(0.01, 0.1, 9), operator


@pytest.mark.parametrize("n_operators", [1, 3])
@pytest.mark.parametrize("size", [1.0, 0.01])
def test_pooling_is_the_normal_posterior(n_operators, size):
    """Where packs hardly differ it is their errors that the grid of spreads is measured by."""
    value, error, operator = draw_packs(n_operators)
    pooled = pool(value * size, error, operator)
    mean, sd = by_matrices(value * size, error, operator)
    np.testing.assert_allclose(np.r_[pooled.fleet, pooled.operator, pooled.pack], mean, atol=1e-5 * error.max())
    np.testing.assert_allclose(np.r_[pooled.fleet_sd, pooled.operator_sd, pooled.pack_sd], sd, rtol=3e-3)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_a_unit_of_measurement_changes_nothing(unit):
    """Two hundred packs, whose evidence alone would be beyond the range of numbers."""
    rng = np.random.default_rng(1)
    value, error, operator = rng.standard_normal(200), np.full(200, 0.3), np.arange(200) % 2
    for plain, other in zip(pool(value, error, operator), pool(unit * value, unit * error, operator), strict=True):
        np.testing.assert_allclose(other, unit * np.asarray(plain), rtol=1e-6)


def test_of_an_operator_that_shows_nothing_only_the_fleet_is_known():
    """A pack of its own has the spread of operators on top of the fleet's doubt, and that of packs on top of it."""
    value, error, operator = draw_packs(3)
    value[operator == 2] = np.nan
    pooled = pool(value, error, operator)
    assert pooled.operator[2] == pytest.approx(pooled.fleet, rel=1e-6)
    assert pooled.pack[2] == pytest.approx(pooled.fleet, rel=1e-6)
    assert pooled.fleet_sd < pooled.operator_sd[2] < pooled.pack_sd[2]


def test_nothing_known_is_nan_not_an_error():
    pooled = pool(np.full(3, np.nan), np.ones(3), np.zeros(3, dtype=int))
    assert np.isnan(pooled.fleet)
    assert np.isnan(pooled.pack).all()


def test_levels_are_named_by_operator_and_pack():
    packs = pl.DataFrame({
        "operator": ["B", "A", "B"], "tail": ["T1", "T2", "T3"], "pack": [1, 2, 1], "value": [1.0, 1.1, 1.2],
        "error_sd": [0.1, 0.1, 0.1], "n": [10, 20, 5],
    })  # fmt: skip
    pooled, levels = levels_of(packs, "x")
    assert [(v.operator, v.tail, v.pack, v.n_flights) for v in levels] == [
        ("A", None, None, 20), ("B", None, None, 15), ("B", "T1", 1, 10), ("A", "T2", 2, 20), ("B", "T3", 1, 5),
    ]  # fmt: skip
    assert [v.value for v in levels] == [*pooled.operator, *pooled.pack]
    assert [v.sd for v in levels] == [*pooled.operator_sd, *pooled.pack_sd]
