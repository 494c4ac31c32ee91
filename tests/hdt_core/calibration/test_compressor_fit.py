"""Joint fits over flights: equation (6), the group and the inlet recovered; health free beside a shared design."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Points, cruise_samples, flights_of, level_points, to_points
from hdt_core.calibration.component_fit import flight_by_flight
from hdt_core.calibration.compressor import ENTRY_WEAR, _as_built, compressor_samples, fit_compressor
from hdt_core.calibration.dsm import flow_elasticities
from hdt_core.calibration.exchanger import exchanger_panel
from hdt_core.calibration.sensor_biases import probe_corrections
from hdt_core.estimation import NonlinearLeastSquares
from hdt_core.estimation.panel import Panel, PanelLeastSquares, Walk
from hdt_core.physics.compressor import COMPRESSOR, group_at_m3, inlet_flow_kg_s
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.records.keys import PACK


def compressor_rows(samples: pl.DataFrame) -> pl.DataFrame:
    packs = samples.select(PACK).unique().sort(PACK)
    return compressor_samples(samples, probe_corrections(samples, packs))


@pytest.fixture(scope="module")
def fit(fleet, fleets):
    return fit_compressor(compressor_rows(fleets.group_flow(fleet.samples)))


def test_recovers_diameter_line(fit, fleets):
    slope_error = abs(fit.slope_m_per_count - fleets.SLOPE_M)
    assert slope_error < 3.0 * fit.slope_sd_m_per_count < 0.3 * abs(fleets.SLOPE_M)
    assert abs(fit.intercept_m - fleets.INTERCEPT_M) < 3.0 * fit.intercept_sd_m


def test_recovers_scatter_of_line(fit, fleets):
    """Mean absolute value of a normal error; levels of twenty flights cost one per cent."""
    assert fit.mae_m == pytest.approx(fleets.SCATTER_M * np.sqrt(2.0 / np.pi), rel=0.06)
    assert fit.mae_m < 0.0055
    assert fit.scatter_m == pytest.approx(fleets.SCATTER_M, rel=0.06)


def test_line_beats_other_forms(fit):
    """On flights left out."""
    constant, linear, *richer = fit.forms
    assert linear.cv_mae_m < 0.97 * constant.cv_mae_m
    assert constant.aic > linear.aic + 10.0
    for form in richer:
        assert form.cv_mae_m > 0.999 * linear.cv_mae_m
        assert form.r_squared >= linear.r_squared - 1e-12


def test_recovers_share_explained(fit, fleets):
    """Positions uniform over 300 counts: what slope and scatter imply."""
    linear = fit.forms[1]
    explained = fleets.SLOPE_M**2 * 300.0**2 / 12.0
    assert linear.r_squared_low < linear.r_squared < linear.r_squared_high
    assert linear.r_squared == pytest.approx(explained / (explained + fleets.SCATTER_M**2), abs=0.02)


def test_recovers_flow_group(fit, fleets):
    assert fit.group_m3 == pytest.approx(fleets.GROUP_M3, rel=0.005)


GROUP_SLOPE = 3.3e-7


@pytest.fixture(scope="module")
def growing_fit(fleet, fleets):
    """A group that grows by a third of a millionth a count, read by a flow sensor and a position with their noise."""
    rng = np.random.default_rng(5)
    inlet = [fleet.samples[c].to_numpy() for c in ("cc_in_pa", "cc_in_k", "cc_speed_rad_s")]
    group = group_at_m3(fleet.samples["vda_counts"].to_numpy(), fleets.GROUP_M3, 450.0, GROUP_SLOPE)
    flow = inlet_flow_kg_s(group, *inlet) * (1.0 + 0.02 * rng.standard_normal(group.size))
    noise = pl.Series(5.0 * rng.standard_normal(group.size))
    noisy = fleet.samples.with_columns(pl.col("vda_counts") + noise, cc_flow_kg_s=pl.Series(flow))
    return fit_compressor(compressor_rows(noisy))


def test_recovers_group_slope(growing_fit):
    sd = growing_fit.group_slope_sd_m3_per_count
    assert abs(growing_fit.group_slope_m3_per_count - GROUP_SLOPE) < 3.0 * sd < 0.1 * GROUP_SLOPE


def test_constant_group_has_no_slope(fit):
    assert abs(fit.group_slope_m3_per_count) < 0.003 * GROUP_SLOPE


def test_group_inverts_to_position(growing_fit):
    positions = np.array([320.0, 450.0, 580.0])
    np.testing.assert_allclose(growing_fit.position_counts(growing_fit.group_at_m3(positions)), positions, rtol=1e-12)
    assert growing_fit.vda_widest_counts == pytest.approx(600.0, abs=25.0)


def test_worn_machine_keeps_line_steep(fleet, fleets):
    """Speed up by what a loss of diameter asks for: level and slope of that machine shrink, the fleet's don't."""
    order = pl.col("time_utc").rank("dense").over(PACK) / pl.len().over(PACK)
    shrunk = pl.when((pl.col("pack") == 1) & (pl.col("tail") < "T-02")).then(1.0 - 0.15 * order).otherwise(1.0)
    worn = fit_compressor(compressor_rows(fleet.samples.with_columns(pl.col("cc_speed_rad_s") / shrunk)))
    assert abs(worn.slope_m_per_count - fleets.SLOPE_M) < 3.0 * worn.slope_sd_m_per_count
    assert abs(worn.intercept_m - fleets.INTERCEPT_M) < 3.0 * worn.intercept_sd_m


def test_diffuser_noise_keeps_line_steep(fleets):
    """Ten times five counts would flatten the line by a third; declared noise is put back."""
    rng = np.random.default_rng(3)
    n = 40_000
    true = 400.0 + 12.0 * rng.standard_normal(n)
    none = pl.lit(None, pl.Float64)
    frame = pl.DataFrame(
        {
            "diameter_m": fleets.INTERCEPT_M + fleets.SLOPE_M * true,
            "vda_counts": true + 5.0 * rng.standard_normal(n),
            "flight_id": [f"f{k // 8:05d}" for k in range(n)],
            "time_utc": np.arange(n),
        }
    ).with_columns(
        group_m3=none, efficiency=none, operator=pl.lit("TST"), pack=pl.lit(1),
        tail=pl.format("T-{}", pl.int_range(pl.len()) // 4000),
    )  # fmt: skip
    assert fit_compressor(frame).slope_m_per_count == pytest.approx(fleets.SLOPE_M, rel=0.02)


def test_few_points_keep_papers_line(fleet):
    few = fit_compressor(compressor_rows(fleet.samples.head(20)))
    assert few.intercept_m == 0.1731
    assert few.intercept_sd_m >= 0.01


FREE = ("cc_area_diameter_tan_beta_m3", "cc_diameter_vda_intercept")


@pytest.fixture(scope="module")
def grouped_samples(fleet, fleets):
    """One aircraft whose flow follows its group."""
    return fleets.group_flow(fleet.only("T-00").samples)


@pytest.fixture(scope="module")
def single_fits(grouped_samples):
    """Flights fitted one by one, each from where the one before ended."""
    one_by_one = SimpleNamespace(name="nls", estimate=NonlinearLeastSquares().estimate)
    return flight_by_flight(
        grouped_samples, COMPRESSOR, FREE, outputs=("cc_flow_kg_s", "cc_out_pa"), estimator=one_by_one
    )


def test_batched_fit_matches_single_fits(grouped_samples, single_fits):
    batched = flight_by_flight(grouped_samples, COMPRESSOR, FREE, outputs=("cc_flow_kg_s", "cc_out_pa"), estimator=None)
    for column in FREE:
        np.testing.assert_allclose(single_fits[column], batched[column], rtol=1e-6)
    assert single_fits["n_evals"].sum() < 0.8 * batched["n_evals"].sum()


def test_single_fits_recover_group(grouped_samples, single_fits, fleets):
    group_m3 = single_fits[FREE[0]]
    assert set(single_fits["status"]) == {"converged"}
    np.testing.assert_allclose(group_m3, fleets.GROUP_M3, rtol=1e-6)
    sixth = single_fits.row(5, named=True)
    s = grouped_samples.filter(flight_id=sixth["flight_id"], pack=sixth["pack"])
    flow = inlet_flow_kg_s(group_m3[5], *(s[c].to_numpy() for c in ("cc_in_pa", "cc_in_k", "cc_speed_rad_s")))
    np.testing.assert_allclose(flow, s["cc_flow_kg_s"].to_numpy(), rtol=1e-6)


FLOWS = (0.8, 1.2)


def points_of(samples: pl.DataFrame) -> Points:
    packs = samples.select(PACK).unique().sort(PACK)
    return to_points(level_points(cruise_samples(samples), flights_of(samples)), packs)


def fit_panel(points: Points, n_packs: int):
    prior = np.zeros((n_packs, len(hx.BIASES))), np.tile(hx.BIAS_SDS, (n_packs, 1))
    return PanelLeastSquares().estimate(exchanger_panel(points, *prior))[0]


def test_worn_packs_give_same_law(fleet):
    """Left packs lose up to a half in the window, right ones nothing."""
    fits = [fit_panel(points_of(fleet.samples.filter(pl.col("pack") == side)), 5) for side in (1, 2)]
    true = flow_elasticities(fleet.design, *FLOWS)
    for fit in fits:
        assert fit.status == "converged"
        np.testing.assert_allclose(flow_elasticities(fit.belief.mean, *FLOWS), true, atol=0.04)


@pytest.mark.parametrize("rate", [1e-3, 4e-3])
def test_slow_loss_is_not_design(fleet, rate):
    """Exit temperatures of one pack raised as its conductance would, flight by flight."""
    points = points_of(fleet.samples.filter(pl.col("pack") == 2))
    bias = np.zeros((len(hx.BIASES), 1))
    raised = points.signals | {"hx_out_k": points.signals["hx_out_k"] + 0.01}
    here, there = (hx.ln_conductance_ratio(p, fleet.design, bias) for p in (points.signals, raised))
    slope = (there - here) / 0.01
    warmer = np.where(points.pack == 0, -rate * points.flight / slope, 0.0)
    sick = replace(points, signals=points.signals | {"hx_out_k": points.signals["hx_out_k"] + warmer})
    before, after = (fit_panel(p, 5).belief for p in (points, sick))
    assert (np.abs(after.mean - before.mean) / before.sd).max() < 0.5


def test_more_flights_shrink_doubt(fleet):
    points = points_of(fleet.samples)
    early = points.flight < 20
    signals = {n: v[early] for n, v in points.signals.items()}
    few = Points(signals, points.pack[early], points.flight[early], points.n_samples[early])
    small, large = (fit_panel(p, 10).belief.cov for p in (few, points))
    # the volume of doubt over twelve parameters
    assert np.linalg.slogdet(large)[1] < np.linalg.slogdet(small)[1] - 1.0
    for cov in (small, large):
        assert (np.diag(cov) <= hx.SD**2 * (1.0 + 1e-9)).all()


@pytest.fixture(scope="module")
def one_aircraft(fleet) -> Points:
    return points_of(fleet.only("T-00").samples)


def test_coarse_flow_weighs_less(one_aircraft):
    """Its rounding, a twelfth of the step's square, adds to the noise of a point's flow."""
    prior = np.zeros((2, len(hx.BIASES))), np.tile(hx.BIAS_SDS, (2, 1))
    coarse = replace(one_aircraft, flow_step_ln=np.full(len(one_aircraft), 0.1))
    fine_sd, coarse_sd = (exchanger_panel(points, *prior).noise_sd for points in (one_aircraft, coarse))
    added = coarse_sd**2 - fine_sd**2
    np.testing.assert_allclose(added, [[0.1**2 / 12.0, 0.0, 0.0, 0.0, 0.0, 0.0]] * len(added), rtol=1e-9, atol=1e-15)


def test_pack_without_points_keeps_prior(one_aircraft):
    prior = np.full((3, 6), 0.01)
    sd = np.tile(hx.BIAS_SDS, (3, 1))
    bias = PanelLeastSquares().estimate(exchanger_panel(one_aircraft, prior, sd))[1]
    np.testing.assert_array_equal(bias[2], np.full(6, 0.01))
    assert (bias[:2] != 0.01).all()
    # what the caller gave stays
    np.testing.assert_array_equal([prior, sd], [np.full((3, 6), 0.01), np.tile(hx.BIAS_SDS, (3, 1))])


@pytest.fixture
def panel_of(one_aircraft) -> Callable[[int], tuple[Points, Panel]]:
    """Points of two packs, so many of which show the ram outlet, from four samples on; and their panel."""

    def make_panel(n_known: int) -> tuple[Points, Panel]:
        n = np.arange(len(one_aircraft))
        ram_out = np.where(n < n_known, one_aircraft.signals["ram_out_k"], np.nan)
        points = replace(one_aircraft, signals=one_aircraft.signals | {"ram_out_k": ram_out}, n_samples=n + 4.0)
        return points, exchanger_panel(points, np.zeros((2, 6)), np.tile(hx.BIAS_SDS, (2, 1)))

    return make_panel


@pytest.mark.parametrize(("n_known", "effect", "others"), [(19, 40.0, []), (20, 10.0, [(0.015, 10.0)])])
def test_panel_is_as_declared(panel_of, n_known, effect, others):
    """Health walks by 0.01 a flight from within 0.3, a flight scatters by 0.02; the law errs by 1 %, the balance of the
    ram flow by 1.5. Of neighbouring points ten count as one, forty where fewer than twenty show the ram flow."""
    _, panel = panel_of(n_known)
    assert (panel.walk, panel.levelled.sd, panel.levelled.design_effect) == (Walk(0.01, 0.02, 0.3), 0.01, effect)
    assert [(e.sd, e.design_effect) for e in panel.others] == others
    np.testing.assert_array_equal(panel.prior.sd, hx.SD)
    np.testing.assert_array_equal(panel.bounds.T, [hx.LOW, hx.HIGH])


@pytest.mark.parametrize("n_known", [19, 20])
def test_point_averages_six_samples(panel_of, n_known):
    """At most."""
    _, panel = panel_of(n_known)
    expected = [hx.NOISE_SDS / np.sqrt(n) for n in (4, 5, 6, 6)]
    np.testing.assert_allclose(panel.noise_sd[:4], expected)


@pytest.mark.parametrize(
    ("n_known", "ratios"),
    [(19, [hx.ln_conductance_ratio]), (20, [hx.ln_conductance_ratio, hx.ln_ram_flow_ratio])],
)
def test_panel_equations_are_ratios(panel_of, n_known, ratios):
    points, panel = panel_of(n_known)
    bias = 0.5 * hx.BIAS_SDS[:, None]
    for equation, ratio in zip((panel.levelled, *panel.others), ratios, strict=True):
        np.testing.assert_array_equal(equation.residual(hx.MEAN, bias), ratio(points.signals, hx.MEAN, bias))


@pytest.mark.parametrize("n_known", [19, 20])
def test_panel_prior_is_flow_ratio(panel_of, n_known):
    """Of ram to bleed flow, 1.5 to 15 %."""
    points, panel = panel_of(n_known)
    flow = np.nanmedian(np.log(clean_ram_flow_kg_s(points.signals, hx.MEAN) / points.signals["pack_flow_kg_s"]))
    np.testing.assert_allclose(panel.prior_terms(hx.MEAN), (flow - np.log(1.5)) / 0.15)


@pytest.mark.parametrize("faulty", [[], [0.91]], ids=["sound", "one reads 17 % high"])
def test_faulty_sensor_leaves_built_level(faulty):
    levels = np.array([*np.linspace(0.76, 0.78, 19), *faulty])

    as_built, _ = _as_built(levels, 2.0 * ENTRY_WEAR)

    assert as_built == pytest.approx(0.775, abs=0.01)
