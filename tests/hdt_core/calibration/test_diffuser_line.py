"""Equation (6) over blocks of flights, its rivals, and levels as built: least squares by hand."""

import numpy as np
import polars as pl
import pytest
from scipy.stats import exponnorm, norm

from hdt_core.calibration.compressor import _as_built, _pool, fit_compressor, inlet_geometry
from hdt_core.calibration.diffuser_line import BlockRows, _clustered_sd, compare_forms, fit_line, rows_of
from hdt_core.calibration.pooling import pool


def machine_rows(n_flights: int, per_flight: int = 4, *, scatter: float = 0.0, bend: float = 0.0, seed: int = 1):
    """Two machines of levels 0.16 and 0.2, equally steep for their size: 1e-4 of it a count from 400."""
    rng = np.random.default_rng(seed)
    flight = np.repeat(np.arange(n_flights), per_flight)
    x = rng.uniform(300.0, 500.0, flight.size)
    block = flight * 2 // n_flights
    level = np.where(block == 0, 0.16, 0.20)
    y = level * (1.0 - 1e-4 * (x - 400.0) + bend * (x - 400.0) ** 2) + scatter * rng.standard_normal(flight.size)
    blocks = pl.DataFrame({"operator": "O", "tail": ["A", "B"], "pack": [1, 1], "turn": [0, 0]})
    return BlockRows(x, y, block, flight, blocks)


def test_line_spans_two_machine_sizes():
    """Its slope is that of the mean level, raised by what a noise of 5 counts takes from it."""
    rows = machine_rows(40)
    line = fit_line(rows)
    inside = rows.x - np.where(rows.block == 0, *(rows.x[rows.block == b].mean() for b in (0, 1)))
    reliable = 1.0 - 25.0 / np.mean(inside**2)
    centre = rows.x.mean()
    np.testing.assert_allclose(line.centre, centre)
    np.testing.assert_allclose(line.level, np.array([0.16, 0.20]) * (1.0 - 1e-4 * (centre - 400.0)), rtol=1e-6)
    assert line.slope == pytest.approx(-1e-4 * 0.18 / reliable, rel=1e-6)
    np.testing.assert_allclose(line.residual, 0.0, atol=1e-9)
    # Scores 1 x 2 x 1 + 0.95 x 3 x 2 of one flight and 0.5 x 1 x 4 of another, over 2 squared of the one inside.
    values = np.array([2.0, 3.0, 1.0]), np.array([1.0, 2.0, 4.0]), np.array([0, 0, 1]), np.array([1.0, 0.95, 0.5])
    assert _clustered_sd(*values) == pytest.approx(np.hypot(2.0 + 5.7, 2.0) / 4.0)
    # Positions that spread by less than twice their noise: the slope is doubled, no more.
    calm = BlockRows(400.0 + (rows.x - 400.0) / 20.0, rows.y, rows.block, rows.flight, rows.blocks)
    plain = fit_line(rows)
    inside = rows.x - np.array([rows.x[rows.block == b].mean() for b in (0, 1)])[rows.block]
    raised = 1.0 - 25.0 / np.mean(inside**2)
    assert fit_line(calm).slope == pytest.approx(plain.slope * raised * 20.0 / 0.5, rel=1e-6)


def test_slope_error_clusters_by_flight():
    """The sandwich over flights; each sample thrice, the error stays what it was."""
    rows = machine_rows(200, scatter=0.002)
    line = fit_line(rows)
    x_mean = np.array([rows.x[rows.block == b].mean() for b in (0, 1)])
    inside = rows.x - x_mean[rows.block]
    score = np.bincount(rows.flight, inside * line.residual)
    plain = np.sqrt((score**2).sum()) / (inside**2).sum()
    assert line.slope_sd == pytest.approx(plain, rel=0.15)
    assert abs(line.slope + 1e-4 * 0.18) < 4.0 * line.slope_sd
    calm = BlockRows(400.0 + (rows.x - 400.0) / 20.0, rows.y, rows.block, rows.flight, rows.blocks)
    raised = 1.0 - 25.0 / np.mean(inside**2)
    assert fit_line(calm).slope_sd == pytest.approx(line.slope_sd * raised * 20.0 / 0.5, rel=1e-3)
    thrice = BlockRows(*(np.repeat(v, 3) for v in (rows.x, rows.y, rows.block, rows.flight)), rows.blocks)
    assert fit_line(thrice).slope_sd == pytest.approx(line.slope_sd, rel=1e-6)
    wild = rows.y.copy()
    wild[::80] += 0.2
    wild[40::80] -= 0.2
    robust = fit_line(BlockRows(rows.x, wild, rows.block, rows.flight, rows.blocks))
    assert robust.slope == pytest.approx(line.slope, abs=3.0 * line.slope_sd)


def frame(x: list[float], flights: list[int], y: float = 0.17, tail: str = "A") -> pl.DataFrame:
    return pl.DataFrame({
        "operator": "O", "tail": tail, "pack": 1, "time_utc": pl.Series(range(len(x))),
        "flight_id": [f"F{k:03d}" for k in flights], "vda_counts": x, "diameter_m": y,
    })  # fmt: skip


def test_position_spikes_are_left_out():
    """Four robust deviations and the sensor's noise from the pack's middle: 4 x 1.4826 x 10 + 5."""
    calm = [*[390.0, 410.0] * 41, 400.0, 400.0]
    reach = 4.0 * 1.4826 * 10.0 + 5.0
    for off, n_rows in ((reach - 0.1, 85), (reach + 0.1, 84)):
        rows = rows_of(frame([*calm, 400.0 + off], list(range(85))), "diameter_m")
        assert len(rows.x) == n_rows
    assert len(rows_of(frame([400.0] * 84 + [405.0], list(range(85))), "diameter_m").x) == 85  # the noise itself
    rows = rows_of(frame(calm[:42], list(range(42))), "diameter_m")
    assert np.bincount(rows.block).tolist() == [20, 20, 2]
    assert rows.flight.tolist() == list(range(42))
    assert rows.blocks["turn"].to_list() == [0, 1, 2]


def test_built_line_is_raised_for_wear():
    """Two machines of 0.16 and 0.20 m: as built 0.18 m and the wear of their entry; the slope grows with it."""
    rows = machine_rows(40)
    frames = [
        frame(list(rows.x[rows.block == b]), list(rows.flight[rows.block == b] % 20), tail=tail).with_columns(
            diameter_m=pl.Series(rows.y[rows.block == b]), group_m3=pl.lit(9e-4), efficiency=pl.lit(0.8)
        )
        for b, tail in enumerate("AB")
    ]
    fit, line = fit_compressor(pl.concat(frames)), fit_line(rows)
    # a flow sensor's 2 % and .3 % of an efficiency are no pack's own
    group = _pool(pl.concat(frames), "group_m3", "cc_area_diameter_tan_beta_m3", 0.02, wear=False)[2]
    assert fit.levels == (*group, *_pool(pl.concat(frames), "efficiency", "cc_efficiency", 0.003, wear=True)[2])
    as_built, as_built_sd = _as_built(line.level, 0.003)
    slope = line.slope * as_built / line.level.mean()
    slope_sd = np.hypot(line.slope_sd, slope * as_built_sd / as_built)
    assert (fit.slope_m_per_count, fit.slope_sd_m_per_count) == pytest.approx((slope, slope_sd))
    assert (fit.intercept_m, fit.vda_counts) == pytest.approx((as_built - slope * line.centre, line.centre))
    assert fit.intercept_sd_m == pytest.approx(np.hypot(as_built_sd, slope_sd * line.centre))
    assert (fit.vda_widest_counts, fit.n_flights) == (rows.x.max(), 40)
    assert fit.mae_m == fit.forms[1].cv_mae_m
    assert fit.r_squared == fit.forms[1].r_squared


def test_forms_are_compared_out_of_sample():
    """A parabola: the line's error is that of the bend, the quadratic's of the scatter; a level costs a parameter."""
    bent = machine_rows(60, scatter=1e-4, bend=2e-6)
    constant, linear, quadratic, cubic = compare_forms(bent)
    assert [f.form for f in compare_forms(bent)] == ["constant", "linear", "quadratic", "cubic"]
    assert quadratic.aic == 0.0 < cubic.aic < 10.0 < linear.aic < constant.aic
    assert constant.r_squared == 0.0
    level = np.where(bent.block == 0, 0.16, 0.20)
    for form, degree in ((constant, 0), (linear, 1), (quadratic, 2)):
        levels = [(bent.block == b).astype(float) for b in (0, 1)]
        basis = np.stack(levels + [(bent.x / 100.0) ** k for k in range(1, degree + 1)], 1)
        rest = bent.y - basis @ np.linalg.lstsq(basis, bent.y, rcond=None)[0]
        about = bent.y - np.array([bent.y[bent.block == b].mean() for b in (0, 1)])[bent.block]
        assert form.r_squared == pytest.approx(1.0 - (rest**2).sum() / (about**2).sum(), abs=1e-9)
        left = np.empty(bent.y.size)
        for fold in range(5):
            out = bent.flight % 5 == fold
            left[out] = (bent.y - basis @ np.linalg.lstsq(basis[~out], bent.y[~out], rcond=None)[0])[out]
        assert form.cv_mae_m == pytest.approx(np.abs(left).mean(), rel=1e-6)
        assert form.cv_rmse_m == pytest.approx(np.sqrt((left**2).mean()), rel=1e-6)
        n = bent.y.size
        if degree == 1:
            gain = n * np.log((rest**2).mean() / (about**2).mean())
            assert linear.aic - constant.aic == pytest.approx(gain + 2.0, abs=1e-6)
            assert form.r_squared_low < form.r_squared < form.r_squared_high < form.r_squared + 0.2
    assert level.mean() == pytest.approx(0.18)
    assert compare_forms(machine_rows(4)) == ()
    assert len(compare_forms(machine_rows(5))) == 4


def as_built_by_hand(levels: np.ndarray, wear: float) -> tuple[float, float]:
    """Of machines that differ by 2 %, their wear exponential with a mean known to a factor of exp(1.5)."""
    above, score = np.linspace(-0.1, 0.25, 351), np.linspace(-2.5, 2.5, 31)
    level = np.median(np.log(levels)) + above
    chance = np.zeros(level.size)
    for mean, prior in zip(wear * np.exp(1.5 * score), norm.pdf(score), strict=True):
        density = exponnorm.pdf(level[:, None] - np.log(levels), mean / 0.02, scale=0.02)
        chance += prior * density.prod(axis=1)
    middle = np.average(level, weights=chance)
    return np.exp(middle), np.exp(middle) * np.sqrt(np.average((level - middle) ** 2, weights=chance))


def test_built_level_lies_above_worn():
    """By what their spread tells of wear that is exponential: many alike are hardly worn, two tell little."""
    for levels in (np.array([0.16, 0.17, 0.18]), np.array([0.17, 0.17]), np.array([0.17])):
        assert _as_built(levels, 0.003) == pytest.approx(as_built_by_hand(levels, 0.003), rel=1e-5)
    two, many = (_as_built(np.full(n, 0.17), 0.003) for n in (2, 40))
    assert many[0] < two[0] < 0.17 * 1.02
    assert many[1] < 0.005 * 0.17 < 0.012 * 0.17 < two[1]
    rng = np.random.default_rng(3)
    worn = 0.8 * np.exp(0.02 * rng.standard_normal(300) - rng.exponential(0.04, 300))
    value, sd = _as_built(worn, 0.006)
    assert abs(value - 0.8) < 3.0 * sd < 0.015 < 0.8 - np.median(worn)

    def fit(n: int):
        return fit_compressor(frame([380.0 + k for k in range(n)], list(range(n))).with_columns(
            group_m3=pl.lit(None, pl.Float64), efficiency=pl.lit(None, pl.Float64)))  # fmt: skip

    few = fit(29)
    assert (few.intercept_m, few.slope_m_per_count, few.scatter_m, few.vda_counts) == (
        0.1731, -2.9304e-5, 0.0055, 400.0,
    )  # fmt: skip
    assert (few.group_m3, few.efficiency, few.n_flights) == (7.6e-4, 0.75, 29)
    assert fit(30).intercept_m != 0.1731
    # A D tan(beta) of 8e-4 m3 at 36 degrees and a hub of 0.4 eyes.
    inlet = inlet_geometry(8e-4, 2e-5)
    eye = (8e-4 / (0.25 * np.pi * 0.84 * np.tan(np.deg2rad(36.0)))) ** (1.0 / 3.0)
    assert inlet["cc_eye_diameter_m"][0] == pytest.approx(eye)
    share = np.hypot(2e-5 / 8e-4, np.deg2rad(3.0) / (np.sin(np.deg2rad(36.0)) * np.cos(np.deg2rad(36.0)))) / 3.0
    assert inlet["cc_eye_diameter_m"][1] == pytest.approx(share * eye)
    area = 0.25 * np.pi * 0.84 * eye**2
    assert inlet["cc_inlet_area_m2"] == pytest.approx((area, 2 * share * area))
    assert inlet["cc_blade_angle_rad"] == (np.deg2rad(36.0), np.deg2rad(3.0))


def test_efficiency_is_of_first_flights():
    rows = pl.concat([
        frame([400.0] * 30, list(range(30)), tail=tail).with_columns(
            efficiency=pl.when(pl.int_range(30) < 20).then(level).otherwise(0.5)
        )
        for tail, level in (("A", 0.78), ("B", 0.80), ("C", 0.82))
    ])  # fmt: skip
    value, sd, levels = _pool(rows, "efficiency", "cc_efficiency", 0.003, wear=True)
    assert (value, sd) == pytest.approx(as_built_by_hand(np.array([0.78, 0.80, 0.82]), 0.006), rel=1e-5)
    assert [v.n_flights for v in levels] == [60, 20, 20, 20]
    middle = np.array([0.78, 0.80, 0.82])
    scatter = np.array([np.std([m] * 20 + [0.5] * 10, ddof=1) for m in middle]) * 1.2533 / np.sqrt(30.0)
    by_hand = pool(middle, np.hypot(scatter, 0.02 * middle), np.zeros(3, dtype=int))
    assert _pool(rows, "efficiency", "cc_efficiency", 0.02, wear=False)[:2] == pytest.approx(by_hand[:2])
    # of one flight a pack 5 % are taken for its scatter
    lone = pool(middle, middle * np.hypot(0.05 * 1.2533, 0.02), np.zeros(3, dtype=int))
    first = rows.filter(pl.col("flight_id") == "F000")
    assert _pool(first, "efficiency", "cc_efficiency", 0.02, wear=False)[:2] == pytest.approx(lone[:2])
    assert _pool(rows.clear(), "efficiency", "cc_efficiency", 0.02, wear=True) == (0.75, 0.05, ())
