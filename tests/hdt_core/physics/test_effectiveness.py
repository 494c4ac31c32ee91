"""Effectiveness against the exact integral, its limits, and its way back."""

import warnings

import ht
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import gammainc, i0e, i1e

from hdt_core.physics import effectiveness
from hdt_core.physics.effectiveness import (
    counterflow_effectiveness,
    crossflow_effectiveness,
    crossflow_effectiveness_and_slope,
    crossflow_ntu,
)

transfer_units = st.floats(0.01, 8.0)
ratios = st.floats(0.05, 1.0)
GRID = [(n, c) for n in (0.05, 0.3, 1.0, 1.5, 2.5, 5.0, 10.0) for c in (0.05, 0.3, 0.7, 1.0)]


each_point = pytest.mark.parametrize(("ntu", "ratio"), GRID)


def test_published_effectiveness_is_reproduced():
    assert crossflow_effectiveness(1.5, 1.05) == pytest.approx(0.617790718, abs=5e-10)


@each_point
def test_crossflow_equals_exact_integral(ntu, ratio):
    exact = ht.effectiveness_from_NTU(ntu, ratio, subtype="crossflow")
    assert crossflow_effectiveness(ntu, ntu * ratio) == pytest.approx(exact, abs=1e-11)


@each_point
def test_counterflow_equals_ht(ntu, ratio):
    assert counterflow_effectiveness(ntu, ratio) == pytest.approx(ht.effectiveness_from_NTU(ntu, ratio), rel=1e-12)


def by_incomplete_gamma(this, other):
    """The series term by term from SciPy's incomplete gamma function: slow, and no recurrence to lose digits."""
    n = np.arange(1, int(min(this, other) + 12.0 * np.sqrt(min(this, other)) + 60.0))
    return np.sum(gammainc(n, this) * gammainc(n, other)) / other


@pytest.mark.parametrize("ratio", [0.0, 1e-3, 0.3, 0.9, 0.99, 0.999, 1.0])
@pytest.mark.parametrize("ntu", [1e-6, 0.3, 10.0, 24.9, 25.1, 60.0, 350.0, 1e3, 3e4, 1e6])
def test_series_holds_for_any_ntu(ntu, ratio):
    this = ntu
    other = ntu * ratio
    exact = by_incomplete_gamma(this, other) if ratio else -np.expm1(-ntu)
    assert crossflow_effectiveness(this, other) == pytest.approx(exact, rel=1e-14)
    if ratio:
        assert crossflow_effectiveness(other, this) == pytest.approx(exact * ratio, rel=1e-14)


def test_balanced_streams_have_a_closed_form():
    """1 - e^-2N [I0(2N) + I1(2N)], from which 1 / sqrt(pi N) is left."""
    ntu = np.geomspace(0.1, 1e6, 200)
    short = 1.0 - crossflow_effectiveness(ntu, ntu)
    np.testing.assert_allclose(short, i0e(2.0 * ntu) + i1e(2.0 * ntu), atol=2e-15)
    assert crossflow_effectiveness(1e3, 1e3) == pytest.approx(0.98216, abs=1e-5)


@pytest.mark.parametrize("ntu", [20.0, 100.0, 300.0])
def test_balanced_streams_equal_ht(ntu):
    expected = ht.effectiveness_from_NTU(ntu, 1.0, subtype="crossflow")
    assert crossflow_effectiveness(ntu, ntu) == pytest.approx(expected, abs=1e-12)


def test_ht_ends_at_350_units():
    with warnings.catch_warnings(action="ignore"):
        assert not np.isfinite(ht.effectiveness_from_NTU(1000.0, 1.0, subtype="crossflow"))


def test_inverse_keeps_available_digits():
    """To 1e-12 wherever rounding the effectiveness leaves a twentieth of that; elsewhere to what rounding leaves."""
    rng = np.random.default_rng(17)
    ntu = 10.0 ** rng.uniform(-6.0, 6.0, 4000)
    ratio = rng.uniform(0.0, 1.0, 4000)
    ratio[:800] = 1.0
    ratio[800:1000] = 0.0
    ratio = np.where(rng.random(4000) < 0.3, 1.0 / np.maximum(ratio, 1e-2), ratio)
    eps, slope = crossflow_effectiveness_and_slope(ntu, ntu * ratio)
    left = 2.0**-53 * eps / np.maximum(slope, 1e-300)
    exact = left < 5e-14
    back = crossflow_ntu(eps, ratio)
    assert exact.mean() > 0.6
    np.testing.assert_allclose(back[exact], ntu[exact], rtol=1e-12)
    balanced = np.geomspace(1e-6, 1e6, 500)
    np.testing.assert_allclose(crossflow_ntu(crossflow_effectiveness(balanced, balanced), 1.0), balanced, rtol=1e-12)
    rough = ~exact & (left < 1e-3) & np.isfinite(back)
    # the rounding of ntu * ratio comes on top, which `left` leaves out: 40 times on one processor, 61 on another
    assert np.all(np.abs(back[rough] / ntu[rough] - 1.0) < 100.0 * left[rough])


@pytest.mark.parametrize(("fewest", "most", "looks"), [(1e-6, 0.01, 2), (0.3, 4.0, 3), (1.0, 1e6, 5)])
def test_inverse_takes_few_evaluations(monkeypatch, fewest, most, looks):
    """It is the dearest step of calibration; started from the counterflow exchanger's units it took five and more."""
    rng = np.random.default_rng(3)
    ntu = np.exp(rng.uniform(np.log(fewest), np.log(most), 3000))
    ratio = rng.uniform(0.2, 1.5, 3000)
    ratio = np.where(ntu < 20.0, ratio, 1.0)
    eps = crossflow_effectiveness(ntu, ntu * ratio)
    calls = []
    evaluate = effectiveness.crossflow_effectiveness_and_slope
    monkeypatch.setattr(effectiveness, "crossflow_effectiveness_and_slope", lambda *a: calls.append(1) or evaluate(*a))
    np.testing.assert_allclose(crossflow_ntu(eps, ratio), ntu, rtol=1e-9)
    assert len(calls) <= looks


@given(transfer_units, ratios)
def test_counterflow_is_never_beaten(ntu, ratio):
    ours = float(crossflow_effectiveness(ntu, ntu * ratio))
    assert 0.0 < ours <= float(counterflow_effectiveness(ntu, ratio)) * (1.0 + 1e-13)
    assert ours <= 1.0


@given(transfer_units, transfer_units)
def test_both_sides_carry_same_heat(this, other):
    """Effectiveness times heat-capacity rate is the same seen from either side."""
    here = crossflow_effectiveness(this, other) / this
    there = crossflow_effectiveness(other, this) / other
    assert here == pytest.approx(there, rel=1e-12)


def complex_step_slope(this, other):
    """Slope of the effectiveness where both sides' transfer units grow alike."""
    step = 1.0 + 1e-30j
    return float(crossflow_effectiveness(this * step, other * step).imag) / 1e-30


@given(transfer_units, transfer_units)
def test_slope_is_complex_step(this, other):
    _, slope = crossflow_effectiveness_and_slope(this, other)
    assert slope == pytest.approx(complex_step_slope(this, other), rel=1e-9)


@given(transfer_units)
def test_boundless_side_hides_flow_pattern(ntu):
    assert crossflow_effectiveness(ntu, 0.0) == pytest.approx(-np.expm1(-ntu), rel=1e-12)
    assert counterflow_effectiveness(ntu, 0.0) == pytest.approx(-np.expm1(-ntu), rel=1e-12)
    assert crossflow_effectiveness(1e-9, 1e-9 * ntu) == pytest.approx(1e-9, rel=1e-6)


@given(st.floats(8.0, 1e4), st.floats(0.5, 1.0))
def test_slope_holds_for_many_ntu(ntu, ratio):
    _, slope = crossflow_effectiveness_and_slope(ntu, ntu * ratio)
    assert slope == pytest.approx(complex_step_slope(ntu, ntu * ratio), rel=1e-9, abs=1e-13)


@given(st.floats(0.01, 6.0), st.floats(0.05, 2.0))
def test_inverse_recovers_ntu(ntu, ratio):
    assert crossflow_ntu(crossflow_effectiveness(ntu, ntu * ratio), ratio) == pytest.approx(ntu, rel=1e-9)


def test_bulk_inverse_recovers_ntu():
    ntu = np.random.default_rng(1).uniform(0.0, 4.0, 5000)
    ratio = np.random.default_rng(2).uniform(0.2, 1.8, 5000)
    back = crossflow_ntu(crossflow_effectiveness(ntu, ntu * ratio), ratio)
    np.testing.assert_allclose(back, ntu, rtol=1e-9, atol=1e-12)


def test_impossible_effectiveness_has_no_inverse():
    assert np.isnan(crossflow_ntu([-0.1, 1.0, 1.2, 0.7, 0.5], [0.5, 0.5, 0.5, 1.5, -0.5])).all()


def test_zero_effectiveness_needs_no_units():
    assert crossflow_ntu(0.0, 0.5) == 0.0


def test_missing_units_stay_missing():
    ntu = np.array([1.5, np.nan, 0.3])
    result = crossflow_effectiveness(ntu, 0.7 * ntu)
    assert np.isnan(result).tolist() == [False, True, False]
    assert result[0] == pytest.approx(0.617790718, abs=5e-10)


def test_missing_effectiveness_has_no_inverse():
    assert np.isnan(crossflow_ntu(np.array([np.nan, 0.5]), np.array([0.7, np.nan]))).all()


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 700), slice(700, None)], ids=str)
def test_value_is_independent_of_batch(part):
    """Iterations end for each value by itself, so a flight's numbers are the same whatever shares its run."""
    rng = np.random.default_rng(7)
    ntu = rng.uniform(0.05, 20.0, 2_000)
    ratio = rng.uniform(0.1, 1.2, 2_000)
    value, slope = crossflow_effectiveness_and_slope(ntu, ntu * ratio)
    whole = (value, slope, crossflow_ntu(value, ratio))
    alone = crossflow_effectiveness_and_slope(ntu[part], (ntu * ratio)[part])
    for one, of in zip((*alone, crossflow_ntu(value[part], ratio[part])), whole, strict=True):
        assert np.array_equal(one, of[part])
