"""The joint fit: health free flight by flight beside a design that all share."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import Points, cruise_samples, flights_of, level_points, to_points
from hdt_core.calibration.design_table import flow_elasticities
from hdt_core.calibration.exchanger_fit import fit_exchanger
from hdt_core.records.keys import PACK

FLOWS = (0.8, 1.2)


def points_of(samples: pl.DataFrame) -> Points:
    packs = samples.select(PACK).unique().sort(PACK)
    return to_points(level_points(cruise_samples(samples), flights_of(samples)), packs)


def fitted(points: Points, n_packs: int):
    return fit_exchanger(points, np.zeros((n_packs, len(hx.BIASES))), np.tile(hx.BIAS_SDS, (n_packs, 1)))


def test_worn_packs_tell_the_same_law_as_clean_ones(fleet):
    """Left packs lose up to a half in the window, right ones nothing."""
    fits = [fitted(points_of(fleet.samples.filter(pl.col("pack") == side)), 5) for side in (1, 2)]
    true = flow_elasticities(fleet.design, *FLOWS)
    for fit in fits:
        assert fit.converged
        np.testing.assert_allclose(flow_elasticities(fit.mean, *FLOWS), true, atol=0.04)


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
    shift_sd = np.abs(after.mean - before.mean) / np.sqrt(np.diag(before.cov))
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
    small, large = (fitted(p, 10).cov for p in (few, points))
    # the volume of doubt over twelve parameters
    assert np.linalg.slogdet(large)[1] < np.linalg.slogdet(small)[1] - 1.0
    for cov in (small, large):
        assert (np.diag(cov) <= hx.SD**2 * (1.0 + 1e-9)).all()


def test_pack_without_points_keeps_what_was_known_of_its_sensors(fleet):
    points = points_of(fleet.only("T-00").samples)
    prior, sd = np.full((3, 6), 0.01), np.tile(hx.BIAS_SDS, (3, 1))
    fit = fit_exchanger(points, prior, sd)
    np.testing.assert_array_equal(fit.bias[2], prior[2])


def test_fit_does_not_alter_what_it_is_given(fleet):
    points = points_of(fleet.only("T-00").samples)
    prior, sd = np.zeros((2, 6)), np.tile(hx.BIAS_SDS, (2, 1))
    fit_exchanger(points, prior, sd)
    assert not prior.any()
    np.testing.assert_array_equal(sd, np.tile(hx.BIAS_SDS, (2, 1)))
