"""Equation (6) over blocks of flights, its rivals, and levels as built: least squares by hand."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from scipy.stats import exponnorm, norm

from hdt_core.calibration.compressor import CompressorFit, _as_built, _pool, fit_compressor, inlet_geometry
from hdt_core.calibration.diffuser_line import BlockRows, Line, _clustered_sd, compare_forms, fit_line, rows_of
from hdt_core.calibration.pooling import pool

SIZES = np.array([0.16, 0.20])
"""Levels of two machines."""


def machine_rows(n_flights: int, per_flight: int = 4, *, scatter: float = 0.0, bend: float = 0.0, seed: int = 1):
    """Two machines, equally steep for their size: 1e-4 of it a count from 400."""
    rng = np.random.default_rng(seed)
    flight = np.repeat(np.arange(n_flights), per_flight)
    x = rng.uniform(300.0, 500.0, flight.size)
    block = flight * 2 // n_flights
    y = SIZES[block] * (1.0 - 1e-4 * (x - 400.0) + bend * (x - 400.0) ** 2) + scatter * rng.standard_normal(flight.size)
    blocks = pl.DataFrame({"operator": "O", "tail": ["A", "B"], "pack": [1, 1], "turn": [0, 0]})
    return BlockRows(x, y, block, flight, blocks)


def within_block(values: np.ndarray, rows: BlockRows) -> np.ndarray:
    """Values less the mean of their block."""
    return values - np.array([values[rows.block == b].mean() for b in (0, 1)])[rows.block]


def hold_still(rows: BlockRows) -> BlockRows:
    """The rows with positions that spread by less than twice their noise of 5 counts."""
    return replace(rows, x=400.0 + (rows.x - 400.0) / 20.0)


def reliability(rows: BlockRows) -> float:
    """What a noise of 5 counts leaves of a slope."""
    return 1.0 - 25.0 / np.mean(within_block(rows.x, rows) ** 2)


def test_line_spans_two_machine_sizes():
    """Its slope is that of the mean level, raised by what a noise of 5 counts takes from it."""
    rows = machine_rows(40)
    line = fit_line(rows)
    centre = rows.x.mean()
    np.testing.assert_allclose(line.centre, centre)
    np.testing.assert_allclose(line.level, SIZES * (1.0 - 1e-4 * (centre - 400.0)), rtol=1e-6)
    assert line.slope == pytest.approx(-1e-4 * 0.18 / reliability(rows), rel=1e-6)
    np.testing.assert_allclose(line.residual, 0.0, atol=1e-9)


def test_score_beyond_bend_is_clustered():
    """Scores 1 x 2 x 1 + 0.95 x 3 x 2 of one flight and 0.5 x 1 x 4 of another, over 2 squared of the one inside."""
    values = np.array([2.0, 3.0, 1.0]), np.array([1.0, 2.0, 4.0]), np.array([0, 0, 1]), np.array([1.0, 0.95, 0.5])
    assert _clustered_sd(*values) == pytest.approx(np.hypot(2.0 + 5.7, 2.0) / 4.0)


def test_noise_doubles_slope_at_most():
    rows = machine_rows(40)
    still = fit_line(hold_still(rows))
    assert still.slope == pytest.approx(fit_line(rows).slope * reliability(rows) * 20.0 / 0.5, rel=1e-6)


@pytest.fixture(scope="module")
def noisy() -> BlockRows:
    """Two hundred flights that scatter."""
    return machine_rows(200, scatter=0.002)


def test_slope_error_clusters_by_flight(noisy):
    """The sandwich over flights lets the samples of one err together."""
    line = fit_line(noisy)
    inside = within_block(noisy.x, noisy)
    score = np.bincount(noisy.flight, inside * line.residual)
    assert line.slope_sd == pytest.approx(np.sqrt((score**2).sum()) / (inside**2).sum(), rel=0.15)
    assert abs(line.slope + 1e-4 * 0.18) < 4.0 * line.slope_sd


def test_still_positions_raise_slope_error(noisy):
    raised = fit_line(noisy).slope_sd * reliability(noisy) * 20.0 / 0.5
    assert fit_line(hold_still(noisy)).slope_sd == pytest.approx(raised, rel=1e-3)


def test_repeated_samples_keep_slope_error(noisy):
    thrice = BlockRows(*(np.repeat(v, 3) for v in (noisy.x, noisy.y, noisy.block, noisy.flight)), noisy.blocks)
    assert fit_line(thrice).slope_sd == pytest.approx(fit_line(noisy).slope_sd, rel=1e-6)


def test_spikes_keep_slope(noisy):
    line = fit_line(noisy)
    wild = noisy.y.copy()
    wild[::80] += 0.2
    wild[40::80] -= 0.2
    assert fit_line(replace(noisy, y=wild)).slope == pytest.approx(line.slope, abs=3.0 * line.slope_sd)


def frame(x: list[float], flights: list[int], y: float = 0.17, tail: str = "A") -> pl.DataFrame:
    return pl.DataFrame({
        "operator": "O", "tail": tail, "pack": 1, "time_utc": pl.Series(range(len(x))),
        "flight_id": [f"F{k:03d}" for k in flights], "vda_counts": x, "diameter_m": y,
    })  # fmt: skip


REACH = 4.0 * 1.4826 * 10.0 + 5.0


@pytest.mark.parametrize(
    ("calm", "last", "n_rows"),
    [
        ([*[390.0, 410.0] * 41, 400.0, 400.0], 400.0 + REACH - 0.1, 85),
        ([*[390.0, 410.0] * 41, 400.0, 400.0], 400.0 + REACH + 0.1, 84),
        ([400.0] * 84, 405.0, 85),  # the noise itself
    ],
    ids=["within", "beyond", "still"],
)
def test_position_spikes_are_left_out(calm, last, n_rows):
    """Four robust deviations and the sensor's noise from the pack's middle: 4 x 1.4826 x 10 + 5."""
    assert len(rows_of(frame([*calm, last], list(range(85))), "diameter_m").x) == n_rows


def test_blocks_are_twenty_flights():
    rows = rows_of(frame([390.0, 410.0] * 21, list(range(42))), "diameter_m")
    assert np.bincount(rows.block).tolist() == [20, 20, 2]
    assert rows.flight.tolist() == list(range(42))
    assert rows.blocks["turn"].to_list() == [0, 1, 2]


@pytest.fixture(scope="module")
def machine_line() -> Line:
    return fit_line(machine_rows(40))


@pytest.fixture(scope="module")
def machine_frame() -> pl.DataFrame:
    """Two machines of 0.16 and 0.20 m, as samples."""
    rows = machine_rows(40)
    return pl.concat(
        frame(list(rows.x[rows.block == b]), list(rows.flight[rows.block == b] % 20), tail=tail).with_columns(
            diameter_m=pl.Series(rows.y[rows.block == b]), group_m3=pl.lit(9e-4), efficiency=pl.lit(0.8)
        )
        for b, tail in enumerate("AB")
    )


def test_built_line_is_raised_for_wear(machine_frame, machine_line):
    """As built 0.18 m and the wear of their entry; the slope grows with it."""
    fit = fit_compressor(machine_frame)
    as_built, as_built_sd = _as_built(machine_line.level, 0.003)
    slope = machine_line.slope * as_built / machine_line.level.mean()
    slope_sd = np.hypot(machine_line.slope_sd, slope * as_built_sd / as_built)
    expected = {
        "slope_m_per_count": slope, "slope_sd_m_per_count": slope_sd,
        "intercept_m": as_built - slope * machine_line.centre, "vda_counts": machine_line.centre,
        "intercept_sd_m": np.hypot(as_built_sd, slope_sd * machine_line.centre),
    }  # fmt: skip
    assert {name: getattr(fit, name) for name in expected} == pytest.approx(expected)


def test_built_line_states_its_form(machine_frame):
    fit = fit_compressor(machine_frame)
    linear = fit.forms[1]
    assert (fit.mae_m, fit.r_squared) == (linear.cv_mae_m, linear.r_squared)
    assert (fit.vda_widest_counts, fit.n_flights) == (machine_rows(40).x.max(), 40)


def test_levels_pool_sensor_errors(machine_frame):
    """A flow sensor's 2 % and .3 % of an efficiency are no pack's own."""
    group = _pool(machine_frame, "group_m3", "cc_area_diameter_tan_beta_m3", 0.02, wear=False)[2]
    efficiency = _pool(machine_frame, "efficiency", "cc_efficiency", 0.003, wear=True)[2]
    assert fit_compressor(machine_frame).levels == (*group, *efficiency)


@pytest.fixture(scope="module")
def bent() -> BlockRows:
    """A parabola."""
    return machine_rows(60, scatter=1e-4, bend=2e-6)


def fit_polynomial(rows: BlockRows, degree: int, used: np.ndarray) -> np.ndarray:
    """What a polynomial with a level for each block, learned from some rows, leaves of all."""
    levels = [(rows.block == b).astype(float) for b in (0, 1)]
    basis = np.stack(levels + [(rows.x / 100.0) ** k for k in range(1, degree + 1)], 1)
    return rows.y - basis @ np.linalg.lstsq(basis[used], rows.y[used], rcond=None)[0]


def test_forms_are_ranked_by_aic(bent):
    """The line's error is that of the bend, the quadratic's of the scatter; a level costs a parameter."""
    constant, linear, quadratic, cubic = compare_forms(bent)
    assert [f.form for f in (constant, linear, quadratic, cubic)] == ["constant", "linear", "quadratic", "cubic"]
    assert quadratic.aic == 0.0 < cubic.aic < 10.0 < linear.aic < constant.aic
    rest = fit_polynomial(bent, 1, bent.x > 0.0)
    gain = bent.y.size * np.log((rest**2).mean() / (within_block(bent.y, bent) ** 2).mean())
    assert linear.aic - constant.aic == pytest.approx(gain + 2.0, abs=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_forms_are_compared_out_of_sample(bent, degree):
    """In fifths of the flights."""
    form = compare_forms(bent)[degree]
    left = np.empty(bent.y.size)
    for fold in range(5):
        out = bent.flight % 5 == fold
        left[out] = fit_polynomial(bent, degree, ~out)[out]
    assert (form.cv_mae_m, form.cv_rmse_m) == pytest.approx((np.abs(left).mean(), np.sqrt((left**2).mean())), rel=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_share_explained_is_within_machines(bent, degree):
    rest = fit_polynomial(bent, degree, bent.x > 0.0)
    share = 1.0 - (rest**2).sum() / (within_block(bent.y, bent) ** 2).sum()
    assert compare_forms(bent)[degree].r_squared == pytest.approx(share, abs=1e-9)


def test_constant_form_explains_nothing(bent):
    assert compare_forms(bent)[0].r_squared == 0.0


def test_share_explained_has_interval(bent):
    linear = compare_forms(bent)[1]
    assert linear.r_squared_low < linear.r_squared < linear.r_squared_high < linear.r_squared + 0.2


@pytest.mark.parametrize(("flights", "n_forms"), [(4, 0), (5, 4)])
def test_comparison_needs_five_flights(flights, n_forms):
    assert len(compare_forms(machine_rows(flights))) == n_forms


def as_built_by_hand(levels: np.ndarray, wear: float) -> tuple[float, float]:
    """Of machines that differ by 2 %, their wear exponential with a mean known to a factor of exp(1.5)."""
    score = np.linspace(-2.5, 2.5, 31)
    level = np.median(np.log(levels)) + np.linspace(-0.1, 0.25, 351)
    chance = np.zeros(level.size)
    for mean, prior in zip(wear * np.exp(1.5 * score), norm.pdf(score), strict=True):
        density = exponnorm.pdf(level[:, None] - np.log(levels), mean / 0.02, scale=0.02)
        chance += prior * density.prod(axis=1)
    middle = np.average(level, weights=chance)
    return np.exp(middle), np.exp(middle) * np.sqrt(np.average((level - middle) ** 2, weights=chance))


@pytest.mark.parametrize("levels", [[0.16, 0.17, 0.18], [0.17, 0.17], [0.17]])
def test_built_level_matches_hand_computation(levels):
    """By what their spread tells of wear that is exponential."""
    assert _as_built(np.array(levels), 0.003) == pytest.approx(as_built_by_hand(np.array(levels), 0.003), rel=1e-5)


def test_many_like_machines_are_hardly_worn():
    """Two tell little."""
    two, many = (_as_built(np.full(n, 0.17), 0.003) for n in (2, 40))
    assert many[0] < two[0] < 0.17 * 1.02
    assert many[1] < 0.005 * 0.17 < 0.012 * 0.17 < two[1]


def test_recovers_built_level_from_worn():
    rng = np.random.default_rng(3)
    worn = 0.8 * np.exp(0.02 * rng.standard_normal(300) - rng.exponential(0.04, 300))
    value, sd = _as_built(worn, 0.006)
    assert abs(value - 0.8) < 3.0 * sd < 0.015 < 0.8 - np.median(worn)


def fit_points(n: int) -> CompressorFit:
    none = pl.lit(None, pl.Float64)
    rows = frame([380.0 + k for k in range(n)], list(range(n)))
    return fit_compressor(rows.with_columns(group_m3=none, efficiency=none))


def test_few_points_keep_papers_law():
    few = fit_points(29)
    law = {
        "intercept_m": 0.1731, "slope_m_per_count": -2.9304e-5, "scatter_m": 0.0055, "vda_counts": 400.0,
        "group_m3": 7.6e-4, "efficiency": 0.75, "n_flights": 29,
    }  # fmt: skip
    assert {name: getattr(few, name) for name in law} == law
    assert fit_points(30).intercept_m != 0.1731


def test_inlet_geometry_by_hand():
    """A D tan(beta) of 8e-4 m3 at 36 degrees and a hub of 0.4 eyes."""
    angle = np.deg2rad(36.0)
    eye = (8e-4 / (0.25 * np.pi * 0.84 * np.tan(angle))) ** (1.0 / 3.0)
    share = np.hypot(2e-5 / 8e-4, np.deg2rad(3.0) / (np.sin(angle) * np.cos(angle))) / 3.0
    area = 0.25 * np.pi * 0.84 * eye**2
    assert inlet_geometry(8e-4, 2e-5) == {
        "cc_eye_diameter_m": pytest.approx((eye, share * eye)),
        "cc_inlet_area_m2": pytest.approx((area, 2 * share * area)),
        "cc_blade_angle_rad": (angle, np.deg2rad(3.0)),
    }


MIDDLE = np.array([0.78, 0.80, 0.82])


@pytest.fixture(scope="module")
def efficiencies() -> pl.DataFrame:
    """Three packs, each of one efficiency for twenty flights and of a poor one after."""
    return pl.concat([
        frame([400.0] * 30, list(range(30)), tail=tail).with_columns(
            efficiency=pl.when(pl.int_range(30) < 20).then(level).otherwise(0.5)
        )
        for tail, level in zip("ABC", MIDDLE, strict=True)
    ])  # fmt: skip


def pool_efficiency(rows: pl.DataFrame, error: float, *, wear: bool):
    return _pool(rows, "efficiency", "cc_efficiency", error, wear=wear)


def test_efficiency_is_of_first_flights(efficiencies):
    """The first twenty, and raised by wear."""
    value, sd, levels = pool_efficiency(efficiencies, 0.003, wear=True)
    assert (value, sd) == pytest.approx(as_built_by_hand(MIDDLE, 0.006), rel=1e-5)
    assert [v.n_flights for v in levels] == [60, 20, 20, 20]


def test_unworn_efficiency_is_pooled(efficiencies):
    scatter = np.array([np.std([m] * 20 + [0.5] * 10, ddof=1) for m in MIDDLE]) * 1.2533 / np.sqrt(30.0)
    by_hand = pool(MIDDLE, np.hypot(scatter, 0.02 * MIDDLE), np.zeros(3, dtype=int))
    assert pool_efficiency(efficiencies, 0.02, wear=False)[:2] == pytest.approx(by_hand[:2])


def test_single_flights_scatter_by_five_percent(efficiencies):
    lone = pool(MIDDLE, MIDDLE * np.hypot(0.05 * 1.2533, 0.02), np.zeros(3, dtype=int))
    first = efficiencies.filter(pl.col("flight_id") == "F000")
    assert pool_efficiency(first, 0.02, wear=False)[:2] == pytest.approx(lone[:2])


def test_no_efficiency_keeps_prior(efficiencies):
    assert pool_efficiency(efficiencies.clear(), 0.02, wear=True) == (0.75, 0.05, ())
