"""The joint fit: health free flight by flight beside a design that all share."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Points, cruise_samples, flights_of, level_points, to_points
from hdt_core.calibration.design_table import flow_elasticities
from hdt_core.calibration.exchanger_fit import exchanger_panel
from hdt_core.estimation.panel import PanelLeastSquares, Walk
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.records.keys import PACK

FLOWS = (0.8, 1.2)


def points_of(samples: pl.DataFrame) -> Points:
    packs = samples.select(PACK).unique().sort(PACK)
    return to_points(level_points(cruise_samples(samples), flights_of(samples)), packs)


def fitted(points: Points, n_packs: int):
    prior = np.zeros((n_packs, len(hx.BIASES))), np.tile(hx.BIAS_SDS, (n_packs, 1))
    return PanelLeastSquares().estimate(exchanger_panel(points, *prior))[0]


def test_worn_packs_tell_the_same_law_as_clean_ones(fleet):
    """Left packs lose up to a half in the window, right ones nothing."""
    fits = [fitted(points_of(fleet.samples.filter(pl.col("pack") == side)), 5) for side in (1, 2)]
    true = flow_elasticities(fleet.design, *FLOWS)
    for fit in fits:
        assert fit.status == "converged"
        np.testing.assert_allclose(flow_elasticities(fit.belief.mean, *FLOWS), true, atol=0.04)


@pytest.mark.parametrize("rate", [1e-3, 4e-3])
def test_a_slow_loss_put_upon_the_records_is_health_and_not_design(fleet, rate):
    """Exit temperatures of one pack raised as its conductance would, flight by flight."""
    points = points_of(fleet.samples.filter(pl.col("pack") == 2))
    bias = np.zeros((len(hx.BIASES), 1))
    raised = points.signals | {"hx_out_k": points.signals["hx_out_k"] + 0.01}
    here, there = (hx.ln_conductance_ratio(p, fleet.design, bias) for p in (points.signals, raised))
    slope = (there - here) / 0.01
    warmer = np.where(points.pack == 0, -rate * points.flight / slope, 0.0)
    sick = replace(points, signals=points.signals | {"hx_out_k": points.signals["hx_out_k"] + warmer})
    before, after = fitted(points, 5), fitted(sick, 5)
    shift_sd = np.abs(after.belief.mean - before.belief.mean) / before.belief.sd
    assert shift_sd.max() < 0.5


def test_more_flights_leave_less_in_doubt(fleet):
    points = points_of(fleet.samples)
    early = points.flight < 20
    few = Points(
        {n: v[early] for n, v in points.signals.items()},
        points.pack[early],
        points.flight[early],
        points.n_samples[early],
    )
    small, large = (fitted(p, 10).belief.cov for p in (few, points))
    # the volume of doubt over twelve parameters
    assert np.linalg.slogdet(large)[1] < np.linalg.slogdet(small)[1] - 1.0
    for cov in (small, large):
        assert (np.diag(cov) <= hx.SD**2 * (1.0 + 1e-9)).all()


def test_prior_of_a_pack_without_points_stands_and_is_not_altered(fleet):
    points = points_of(fleet.only("T-00").samples)
    prior, sd = np.full((3, 6), 0.01), np.tile(hx.BIAS_SDS, (3, 1))
    bias = PanelLeastSquares().estimate(exchanger_panel(points, prior, sd))[1]
    np.testing.assert_array_equal(bias[2], prior[2])
    assert (bias[:2] != prior[:2]).all()
    assert (prior == 0.01).all()
    np.testing.assert_array_equal(sd, np.tile(hx.BIAS_SDS, (3, 1)))


@pytest.mark.parametrize(("n_known", "effect"), [(19, 40.0), (20, 10.0)])
def test_panel_as_declared(fleet, n_known, effect):
    """Health walks by 0.01 a flight from within 0.3, a flight scatters by 0.02; the law errs by 1 %, the balance of the
    ram flow by 1.5. Of neighbouring points ten count as one, forty where fewer than twenty show the ram flow; a point
    averages six samples at most."""
    points = points_of(fleet.only("T-00").samples)
    ram_out = np.where(np.arange(len(points)) < n_known, points.signals["ram_out_k"], np.nan)
    points = replace(points, signals=points.signals | {"ram_out_k": ram_out}, n_samples=np.arange(len(points)) + 4.0)
    panel = exchanger_panel(points, np.zeros((2, 6)), np.tile(hx.BIAS_SDS, (2, 1)))
    assert (panel.walk, panel.levelled.sd, panel.levelled.design_effect) == (Walk(0.01, 0.02, 0.3), 0.01, effect)
    assert [(e.sd, e.design_effect) for e in panel.others] == [(0.015, 10.0)] * (n_known == 20)
    for row, n in enumerate((4, 5, 6, 6)):
        np.testing.assert_allclose(panel.noise_sd[row], hx.NOISE_SDS / np.sqrt(n))
    bias = 0.5 * hx.BIAS_SDS[:, None]
    ratios = (hx.ln_conductance_ratio, hx.ln_ram_flow_ratio)[: 1 + len(panel.others)]
    for equation, ratio in zip((panel.levelled, *panel.others), ratios, strict=True):
        np.testing.assert_array_equal(equation.residual(hx.MEAN, bias), ratio(points.signals, hx.MEAN, bias))
    flow = np.nanmedian(np.log(clean_ram_flow_kg_s(points.signals, hx.MEAN) / points.signals["pack_flow_kg_s"]))
    np.testing.assert_allclose(panel.prior_terms(hx.MEAN), (flow - np.log(1.5)) / 0.15)
    np.testing.assert_array_equal(panel.prior.sd, hx.SD)
    np.testing.assert_array_equal(panel.bounds.T, [hx.LOW, hx.HIGH])
