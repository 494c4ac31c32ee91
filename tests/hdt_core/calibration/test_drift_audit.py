"""What each pack did over the baseline: straight lines, by hand."""

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, log

from hdt_core.calibration.drift_audit import audit_drift


def audit(ratio: np.ndarray, maintenance: pl.DataFrame | None = None) -> pl.DataFrame:
    return audit_drift(
        flights(len(ratio), ln_ua_ratio=list(map(float, ratio))), log() if maintenance is None else maintenance, DSM
    )


def test_a_straight_line_is_its_slope():
    row = audit(0.05 - 0.001 * np.arange(30)).row(0, named=True)
    assert row["drift_per_100_flights"] == pytest.approx(-0.1)
    assert row["drift_sd"] == pytest.approx(0.0, abs=1e-9)
    # medians of the first and last ten flights: 0.0455 and 0.0255; the clean fleet stands at 0.02
    assert row["anchor"] == pytest.approx(0.0455 - 0.02)
    assert row["unlearned"] == pytest.approx(0.020)
    assert row["drifts"]
    assert row["n_flights"] == 30


@pytest.mark.parametrize(("per_100", "drifts"), [(0.0099, False), (0.0101, True), (-0.0101, True)])
def test_a_drift_is_one_per_cent_in_a_hundred_flights(per_100, drifts):
    assert audit(per_100 / 100.0 * np.arange(30))["drifts"].to_list() == [drifts]


@pytest.mark.parametrize(("times", "drifts"), [(2.9, False), (3.1, True)])
def test_and_three_deviations(times, drifts):
    """Half the width of the interval that holds the slope by 68 %, which a line put on top does not widen."""
    noise = 0.02 * np.sin(2.3 * np.arange(40) ** 1.5)
    bare = audit(noise).row(0, named=True)
    slope = (np.sign(1.0) * times * bare["drift_sd"] - bare["drift_per_100_flights"]) / 100.0
    row = audit(noise + slope * np.arange(40)).row(0, named=True)
    assert row["drift_per_100_flights"] == pytest.approx(times * bare["drift_sd"])
    # of 780 slopes of pairs those a deviation of Kendall's score, sqrt(40 * 39 * 85 / 18), about the middle
    first, later = np.triu_indices(40, 1)
    slopes, half = np.sort((noise[later] - noise[first]) / (later - first)), np.sqrt(40 * 39 * 85 / 18)
    low, high = slopes[round((780 - half) / 2) - 1], slopes[round((780 + half) / 2)]
    assert bare["drift_sd"] == pytest.approx(50.0 * (high - low))
    assert row["drifts"] == drifts


def test_units_are_audited_apart_and_short_ones_not_at_all():
    ratio = np.r_[np.zeros(25), np.full(19, 0.1)]
    entry = log(("T-1", 1, "HX", "REPLACED", 24))
    assert audit(ratio, entry).select("unit", "n_flights", "drifts").rows() == [(0, 25, False)]
    assert audit(np.r_[ratio, 0.1], entry)["unit"].to_list() == [0, 1]
