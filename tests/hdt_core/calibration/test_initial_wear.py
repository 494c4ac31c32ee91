"""Wear that a unit brings along, and the level of clean ones: Bayes' rule over ways to enter, by hand."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, log
from scipy.stats import norm

from hdt_core.calibration.initial_wear import _clean_units, entry_posterior, fleet_levels
from hdt_core.tracking.wear_model import Observation, at_reference

ENTRY = [(0.50, 0.004, 0.005), (0.20, 0.030, 0.020), (0.18, 0.090, 0.040), (0.12, 0.200, 0.080)]


@pytest.mark.parametrize("ratio", [0.05, -0.1, -0.4])
def test_what_is_below_the_level_is_split_between_wear_and_offset(ratio):
    """On a grid of wear: level less wear plus an offset of 0.05 and an error of 0.02."""
    wear = np.linspace(-0.5, 1.0, 60001)
    prior = sum(share * norm.pdf(wear, mean, sd) for share, mean, sd in ENTRY)
    weight = prior * norm.pdf(ratio, 0.03 - wear, np.hypot(0.05, 0.02))
    mean = weight @ wear / weight.sum()
    entry = entry_posterior(np.array([ratio, 0.0]), np.array([0.02**2, 1e-4]), 0.03, 0.05)
    assert entry.wear[0] == pytest.approx(mean, rel=1e-4)
    assert entry.wear_var[0] == pytest.approx(weight @ (wear - mean) ** 2 / weight.sum(), rel=1e-4)


@pytest.mark.parametrize("ratio", [-9.0, 9.0])
def test_far_from_every_class_the_widest_one_is_left(ratio):
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


def test_the_clean_level_is_integrated_over_spread_and_wear():
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


def test_a_fleet_of_hundreds_is_within_the_range_of_numbers():
    """The density of one unit is above 10, that of all together beyond 1e308."""
    ratios, none = np.tile([0.06, -0.02, 0.01], 100), np.zeros(300, dtype=bool)
    together = _clean_units(ratios, np.full(300, 1e-4), none)
    assert together == pytest.approx(clean_units(ratios, [0.01] * 300, none), rel=1e-6)


def test_few_flights_keep_the_scatter_and_a_calm_record_has_a_least_one():
    few = flights(15, ln_ua_ratio=0.0, ln_ua_ratio_sd=0.004, ua_expected_w_k=1900.0)
    assert fleet_levels(few, log(), DSM).flight_sd == pytest.approx(np.sqrt(0.015**2 - 0.004**2))
    calm = flights(21, ln_ua_ratio=0.0, ln_ua_ratio_sd=0.004, ua_expected_w_k=1900.0)
    assert fleet_levels(calm, log(), DSM).flight_sd == 0.005
    assert fleet_levels(calm.head(20), log(), DSM).flight_sd > 0.01


def test_nothing_seen_changes_nothing():
    none = flights(3, ln_ua_ratio=pl.Series([None] * 3, dtype=pl.Float64).to_list(), ln_ua_ratio_sd=0.1)
    assert fleet_levels(none.cast({"ln_ua_ratio": pl.Float64}), log(), DSM) == DSM
    assert replace(DSM) == DSM


@pytest.mark.parametrize("wear", [0.0, 0.1, 0.4])
def test_a_deposit_in_series_is_brought_to_the_reference(wear):
    # conductances in series: 1/UA = 1/UA_clean + film, with the film that gives `wear` at the reference
    clean = np.array([1400.0, 1700.0, 2300.0])
    film = (np.exp(wear) - 1.0) / 1700.0
    ratio = -np.log1p(film * clean)
    none = np.zeros(3, dtype=int)
    observed = at_reference(
        Observation(ratio, np.ones(3), clean / 1700.0, none, none, none, np.ones(3)), np.full(3, wear)
    )
    np.testing.assert_allclose(observed.ratio, -wear, atol=1e-12)
