"""Partial pooling by dense matrices; two sensors of one thing; wear that a unit brings along: Bayes' rule by hand."""

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, START, flights, log, with_bias
from scipy.stats import norm

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.baseline_wear import _clean_units, entry_posterior, fleet_levels
from hdt_core.calibration.pooling import levels_of, pool
from hdt_core.calibration.sensor_biases import exit_differences, probe_corrections, sensor_prior
from hdt_core.records.keys import FLIGHT
from hdt_core.tracking.wear_model import Observation, at_reference

GRID = (0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4)


def by_matrices(value, error, operator) -> np.ndarray:
    """Mean and sd of fleet, operators and packs: a very wide prior on the fleet's mean, a flat one on the spreads."""
    finite = np.isfinite(value)
    n = int(operator.max()) + 1
    unit = max(np.std(value[finite]), np.median(error[finite]))
    # fleet, operators, packs from the fleet's mean, operators' and packs' deviations
    to = np.block([
        [np.ones((1, 1)), np.zeros((1, n + len(value)))],
        [np.ones((n, 1)), np.eye(n), np.zeros((n, len(value)))],
        [np.ones((len(value), 1)), np.eye(n)[operator], np.eye(len(value))],
    ])  # fmt: skip
    rows = 1 + n + np.flatnonzero(finite)
    moments = []
    logs = []
    for a in GRID if n > 1 else [0.0]:
        for b in GRID[1:]:
            deviations = np.diag(np.r_[1e5 * unit**2, [(a * unit) ** 2] * n, [(b * unit) ** 2] * len(value)])
            cov = to @ deviations @ to.T
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
def test_pooling_is_normal_posterior(n_operators, size):
    """Where packs hardly differ it is their errors that the grid of spreads is measured by."""
    value, error, operator = draw_packs(n_operators)
    pooled = pool(value * size, error, operator)
    mean, sd = by_matrices(value * size, error, operator)
    np.testing.assert_allclose(np.r_[pooled.fleet, pooled.operator, pooled.pack], mean, atol=1e-5 * error.max())
    np.testing.assert_allclose(np.r_[pooled.fleet_sd, pooled.operator_sd, pooled.pack_sd], sd, rtol=3e-3)


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_pooling_is_free_of_units(unit):
    """Two hundred packs, whose evidence alone would be beyond the range of numbers."""
    value = np.random.default_rng(1).standard_normal(200)
    error = np.full(200, 0.3)
    operator = np.arange(200) % 2
    for plain, other in zip(pool(value, error, operator), pool(unit * value, unit * error, operator), strict=True):
        np.testing.assert_allclose(other, unit * np.asarray(plain), rtol=1e-6)


def test_silent_operator_has_fleet_level():
    """A pack of its own has the spread of operators on top of the fleet's doubt, and that of packs on top of it."""
    value, error, operator = draw_packs(3)
    value[operator == 2] = np.nan
    pooled = pool(value, error, operator)
    assert (pooled.operator[2], pooled.pack[2]) == pytest.approx((pooled.fleet, pooled.fleet), rel=1e-6)
    assert pooled.fleet_sd < pooled.operator_sd[2] < pooled.pack_sd[2]


def test_hundreds_of_units_stay_finite():
    """The density of one unit is above 10, that of all together beyond 1e308."""
    ratios = np.tile([0.06, -0.02, 0.01], 100)
    none = np.zeros(300, dtype=bool)
    together = _clean_units(ratios, np.full(300, 1e-4), none)
    assert together == pytest.approx(clean_units(ratios, [0.01] * 300, none), rel=1e-6)


def test_empty_pool_is_nan():
    pooled = pool(np.full(3, np.nan), np.ones(3), np.zeros(3, dtype=int))
    assert np.isnan([pooled.fleet, *pooled.pack]).all()


def test_levels_have_names():
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


PACKS = pl.DataFrame({"operator": "TST", "tail": ["A", "A", "B", "B"], "pack": [1, 2, 1, 2]}).cast({"pack": pl.Int32})


def cruise(**columns: list[float | None]) -> pl.DataFrame:
    """One sample a pack."""
    sound = {"pack_flow_kg_s": 0.8, "cc_flow_kg_s": 0.8, "tat_k": 250.0, "cc_in_k": 250.0, "cc_in_pa": 3e4,
             "total_pressure_pa": 3e4, "cc_out_pa": 9e4, "altitude_m": 1e4}  # fmt: skip
    rows = PACKS.with_columns(pl.lit(v).alias(c) for c, v in sound.items())
    rows = rows.with_columns(pl.Series(c, v) for c, v in columns.items())
    return rows.with_columns(flight_id=pl.lit("F"), time_utc=pl.lit(START))


APART = cruise(pack_flow_kg_s=[0.8 * np.exp(0.03), 0.8, 0.9, 0.9], cc_flow_kg_s=[0.8, 0.8, 0.9, 0.9],
               tat_k=[251.0, 252.0, 253.0, 253.0], cc_in_k=[250.0, 250.0, 253.0, 253.0])  # fmt: skip
FLOW = hx.BIASES.index("pack_flow_kg_s")
TAT = hx.BIASES.index("tat_k")


def test_flows_share_difference_evenly():
    """Pack flow and compressor flow, 2 % each."""
    mean, sd = sensor_prior(APART, PACKS)
    np.testing.assert_allclose(mean[:, FLOW], [0.015, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(sd[:, FLOW], 0.02 * np.sqrt(0.5))


def test_tat_takes_share_by_error():
    """TAT has 0.5 K against 1 K over the root of two packs."""
    mean, sd = sensor_prior(APART, PACKS)
    share = 0.25 / (0.25 + 0.5)
    np.testing.assert_allclose(mean[:, TAT], share * np.array([0.75, 0.75, -0.75, -0.75]))
    np.testing.assert_allclose(sd[:, TAT], 0.5 * np.sqrt(1.0 - share))


def test_three_packs_share_tat():
    three = pl.concat([PACKS[:2], PACKS[:1].with_columns(pack=pl.lit(3, pl.Int32)), PACKS[2:]])
    apart = pl.Series([3.0, 1.0, 0.5, 0.0, 0.0])
    more = pl.concat([APART[:2], APART[:1], APART[2:]])
    more = more.with_columns(pack=three["pack"], tat_k=pl.col("cc_in_k") + apart)
    mean = sensor_prior(more, three)[0][:, TAT]
    np.testing.assert_allclose(mean, [0.0, 0.0, 0.0, -0.5, -0.5], atol=1e-12)


def test_other_sensors_keep_declared_error():
    mean, sd = sensor_prior(APART, PACKS)
    others = [k for k in range(6) if k not in (FLOW, TAT)]
    assert not mean[:, others].any()
    np.testing.assert_allclose(sd[:, others], np.tile(hx.BIAS_SDS[others], (4, 1)))


def test_single_sensor_keeps_declared_error():
    unrecorded = dict.fromkeys(("cc_flow_kg_s", "cc_in_k"), pl.Series([None] * 4, dtype=pl.Float64))
    alone = cruise(**unrecorded)
    mean, sd = sensor_prior(alone, PACKS)
    assert not mean.any()
    np.testing.assert_allclose(sd, np.tile(hx.BIAS_SDS, (4, 1)))


def test_compressor_probes_take_their_share():
    """Its inlet has 1 K against TAT's 0.5 K: 0.8 of the difference; .3 % of pressure against .2 %: 9/13."""
    rows = cruise(cc_in_k=[252.0, 250.0, 253.0, 253.0], cc_in_pa=[3e4 * np.exp(0.01), 3e4, 2e4, 2e4],
                  tat_k=[250.0, 250.0, 253.0, 253.0], total_pressure_pa=[3e4, 3e4, 2e4, 2e4])  # fmt: skip
    corrections = probe_corrections(rows, PACKS).select("inlet_bias_k", "inlet_bias_ln", "exit_bias_ln")
    expected = [(1.6, 0.01 * 9.0 / 13.0, 0.0), *[(0.0, 0.0, 0.0)] * 3]
    np.testing.assert_allclose(corrections, expected, atol=1e-12)


@pytest.mark.parametrize(("n_flights", "enough"), [(9, False), (10, True)])
def test_exit_bias_is_beyond_schedule(n_flights, enough):
    """Of four packs ten flights each; one reads 1 % high, which varies more between packs than probes do."""
    rng = np.random.default_rng(2)
    beyond = np.array([0.01, 0.0, -0.002, 0.002])
    rows = []
    for k in range(n_flights):
        height = 1.0 + 0.1 * rng.standard_normal()
        flow = 0.8 * np.exp(0.1 * rng.standard_normal())
        out = np.exp(11.0 + 0.3 * height - 0.2 * height**2 + 0.5 * np.log(flow) + beyond)
        flows = {"pack_flow_kg_s": [1.2 * flow] * 4, "cc_flow_kg_s": [flow / 1.2] * 4}
        one = cruise(altitude_m=[1e4 * height] * 4, cc_out_pa=out, **flows)
        rows.append(one.with_columns(flight_id=pl.lit(f"F{k}")))
    corrections = probe_corrections(pl.concat(rows), PACKS)["exit_bias_ln"].to_numpy()
    share = enough * min(0.8, 0.004**2 / np.var(beyond, ddof=1))
    np.testing.assert_allclose(corrections, share * (beyond - np.median(beyond)), atol=1e-9)


def exits(doors: tuple[float, float]) -> pl.DataFrame:
    """Four samples of two packs whose exits lie 6 K apart, and whose doors stand so."""
    return pl.concat([
        PACKS[:2].with_columns(flight_id=pl.lit("F"), hx_out_k=pl.Series([300.0 + k, 294.0 + k]),
                               ram_door_open=pl.Series(doors))
        for k in (-1.0, 0.0, 0.0, 1.0)
    ])  # fmt: skip


@pytest.mark.parametrize(
    ("doors", "apart"), [((0.5, 0.5), [6.0, -6.0]), ((0.95, 0.05), [6.0, -6.0]), ((0.5, 0.96), [None] * 2)]
)
def test_exits_compare_with_free_doors(doors, apart):
    assert exit_differences(exits(doors)).sort("pack")["apart_k"].to_list() == apart


@pytest.mark.parametrize("doors", [(0.5, 0.5), (0.95, 0.05), (0.5, 0.96)])
def test_lone_exit_has_no_difference(doors):
    assert exit_differences(exits(doors).filter(pack=1))["apart_k"].to_list() == [None]


@pytest.mark.parametrize(("stuck", "is_compared"), [(1, True), (2, False)])
def test_comparison_needs_mostly_free_doors(stuck, is_compared):
    """Free for more than four fifths of a cruise."""
    doors = pl.int_range(pl.len()).over("pack") < stuck
    rows = pl.concat([PACKS[:2]] * 10).with_columns(
        flight_id=pl.lit("F"), hx_out_k=300.0 + 1.0 * pl.col("pack"),
        ram_door_open=pl.when(doors).then(1.0).otherwise(0.5),
    )  # fmt: skip
    assert exit_differences(rows)["apart_k"].is_not_null().all() == is_compared


def test_biases_are_removed_with_sign():
    """A sensor that reads high by its bias meets less than it reads; the flow's is a fraction."""
    readings = {"altitude_m": 1e4, "mach": 0.8, "tat_k": 250.0, "total_pressure_pa": 3e4, "hx_in_k": 400.0,
                "hx_out_k": 300.0, "ram_door_open": 0.4, "pack_flow_kg_s": 0.8, "ram_out_k": 320.0}  # fmt: skip
    bias = np.array([[0.02], [1.0], [2.0], [-0.5], [0.01], [3.0]])
    corrected = hx.without_bias({n: np.array([v]) for n, v in readings.items()}, bias)
    changed = {"pack_flow_kg_s": 0.8 * np.exp(-0.02), "hx_in_k": 399.0, "hx_out_k": 298.0, "tat_k": 250.5,
               "ram_door_open": 0.39, "ram_out_k": 317.0, "mach": 0.8}  # fmt: skip
    assert {n: corrected[n][0] for n in changed} == pytest.approx(changed)


def test_biases_are_those_of_packs():
    dsm = with_bias(("A", 1), ("B", 2), hx_out_k=2.0, tat_k=-0.5)
    bias = dsm.bias_of(PACKS.with_columns(pl.lit(0)))
    np.testing.assert_allclose(bias[2:4], [[2.0, 0.0, 0.0, 2.0], [-0.5, 0.0, 0.0, -0.5]])


def test_unmet_packs_have_no_bias():
    assert not DSM.bias_of(PACKS.with_columns(pl.lit(0))).any()


ENTRY = [(0.50, 0.004, 0.005), (0.20, 0.030, 0.020), (0.18, 0.090, 0.040), (0.12, 0.200, 0.080)]


@pytest.mark.parametrize("ratio", [0.05, -0.1, -0.4])
def test_entry_posterior_splits_wear(ratio):
    """On a grid of wear: level less wear plus an offset of 0.05 and an error of 0.02."""
    wear = np.linspace(-0.5, 1.0, 60001)
    prior = sum(share * norm.pdf(wear, mean, sd) for share, mean, sd in ENTRY)
    weight = prior * norm.pdf(ratio, 0.03 - wear, np.hypot(0.05, 0.02))
    mean = weight @ wear / weight.sum()
    entry = entry_posterior(np.array([ratio, 0.0]), np.array([0.02**2, 1e-4]), 0.03, 0.05)
    assert entry.wear[0] == pytest.approx(mean, rel=1e-4)
    assert entry.wear_var[0] == pytest.approx(weight @ (wear - mean) ** 2 / weight.sum(), rel=1e-4)


@pytest.mark.parametrize("ratio", [-9.0, 9.0])
def test_far_entry_takes_widest_class(ratio):
    """A mean of 0.2 and a deviation of 0.08, against an offset of 0.05 and an error of 0.02."""
    share = 0.08**2 / (0.08**2 + 0.05**2 + 0.02**2)
    entry = entry_posterior(np.array([ratio]), np.array([0.02**2]), 0.03, 0.05)
    assert entry.wear[0] == pytest.approx(0.2 + share * (0.03 - 0.2 - ratio))
    assert entry.wear_var[0] == pytest.approx(0.08**2 * (1.0 - share))


def clean_units(ratios, error, new) -> tuple[float, float, float]:
    """Level with its sd and spread of clean units, on the grids of both."""
    levels = np.median(ratios) + np.linspace(-0.15, 0.25, 81)
    spreads = 0.05 * np.exp(0.2 * np.linspace(-2.5, 2.5, 21))
    weight = -0.5 * (np.log(spreads / 0.05) / 0.2)[:, None] ** 2 + np.zeros(81)
    for value, sd, fresh in zip(ratios, error, new, strict=True):
        ways = [(1.0, *ENTRY[0][1:])] if fresh else ENTRY
        scale = [np.sqrt(way[2] ** 2 + spreads[:, None] ** 2 + sd**2) for way in ways]
        density = [share * np.exp(-0.5 * ((levels - wear - value) / s) ** 2) / s
                   for (share, wear, _), s in zip(ways, scale, strict=True)]  # fmt: skip
        weight += np.log(sum(density))
    weight = np.exp(weight - weight.max())
    weight /= weight.sum()
    mean = weight.sum(0) @ levels
    return mean, np.sqrt(weight.sum(0) @ (levels - mean) ** 2), weight.sum(1) @ spreads


def test_clean_level_is_integrated():
    """Three packs; one gets another core, of which the log tells. Alternate flights are 0.02 apart."""
    levels = [0.06, -0.02, 0.01]
    rows = [
        flights(24 if k == 0 else 12, tail=f"T-{k}", ln_ua_ratio_sd=0.004, ua_expected_w_k=1900.0 + 100 * k)
        .with_columns(
            ln_ua_ratio=level + 0.01 * (-1.0) ** pl.int_range(pl.len())
            + (0.1 if k == 0 else 0.0) * (pl.int_range(pl.len()) >= 12)
        )
        for k, level in enumerate(levels)
    ]  # fmt: skip
    fleet_level = fleet_levels(pl.concat(rows), log(("T-0", 1, "HX", "REPLACED", 11)), DSM)
    step = 1.4826 * 0.02 / np.sqrt(2.0)
    assert fleet_level.flight_sd == pytest.approx(np.sqrt(step**2 - 0.004**2), rel=1e-9)
    error = 1.25 * step / np.sqrt(10.0)
    level, level_sd, spread = clean_units([*levels, 0.16], [error] * 4, [False, False, False, True])
    assert fleet_level.clean_level == pytest.approx(level, rel=1e-6)
    assert fleet_level.clean_level_sd == pytest.approx(level_sd, rel=1e-6)
    assert fleet_level.offset_sd == pytest.approx(spread, rel=1e-6)
    # where ratios lie less than 0.06 below the level: the new core of the first pack
    clean = pl.concat(rows).filter(pl.col("ln_ua_ratio") > level - 0.06)["ua_expected_w_k"].median()
    assert fleet_level.reference_ua_w_k == clean


CALM = flights(21, ln_ua_ratio=0.0, ln_ua_ratio_sd=0.004, ua_expected_w_k=1900.0)


@pytest.mark.parametrize(
    ("n", "scatter"), [(15, np.sqrt(0.015**2 - 0.004**2)), (20, np.sqrt(0.015**2 - 0.004**2)), (21, 0.005)]
)
def test_few_flights_keep_prior_scatter(n, scatter):
    assert fleet_levels(CALM.head(n), log(), DSM).flight_sd == pytest.approx(scatter, rel=1e-12)


@pytest.mark.parametrize(("of_others", "scatter"), [(True, 0.005), (False, 1.4826 * 0.2 / np.sqrt(2.0))])
def test_coarse_flights_show_no_scatter(of_others, scatter):
    """Where flights of a fine flow show it."""
    coarse = CALM.with_columns(tail=pl.lit("C"), ln_ua_ratio=0.1 * (-1.0) ** pl.int_range(pl.len()))
    rows = pl.concat([CALM, coarse]) if of_others else coarse
    flight_sd = fleet_levels(rows, log(), DSM, coarse.select(FLIGHT)).flight_sd
    assert flight_sd == pytest.approx(scatter, rel=1e-3)


def test_no_ratio_changes_no_level():
    none = CALM.head(3).with_columns(ln_ua_ratio=pl.lit(None, pl.Float64))
    assert fleet_levels(none, log(), DSM) == DSM


@pytest.mark.parametrize("wear", [0.0, 0.1, 0.4])
def test_deposit_is_brought_to_reference(wear):
    # conductances in series: 1/UA = 1/UA_clean + film, with the film that gives `wear` at the reference
    clean = np.array([1400.0, 1700.0, 2300.0])
    film = (np.exp(wear) - 1.0) / 1700.0
    ratio = -np.log1p(film * clean)
    none = np.zeros(3, dtype=int)
    flight = Observation(ratio, np.ones(3), clean / 1700.0, none, none, none, np.ones(3))
    observed = at_reference(flight, np.full(3, wear))
    np.testing.assert_allclose(observed.ratio, -wear, atol=1e-12)
