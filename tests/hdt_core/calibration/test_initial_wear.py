"""Wear that a unit brings along, and the level of clean ones."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from seen import NO_LOG, seen_flights

from hdt_core.calibration.initial_wear import entry_posterior, fleet_levels
from hdt_core.tracking.wear_model import Observation, at_reference


def test_what_is_seen_below_the_level_is_split_between_wear_and_offset():
    seen = np.linspace(0.1, -0.5, 25)
    found = entry_posterior(seen, np.full(25, 1e-4), 0.0, 0.05)
    assert (np.diff(found.wear) > 0.0).all()
    assert (found.wear >= 0.0).all()
    # a step of 0.5 can't be an offset of 0.05
    assert found.wear[-1] > 0.25
    assert (found.wear_var > 0.0).all()


def test_a_sharper_offset_leaves_less_doubt():
    wide, sharp = (entry_posterior(np.array([-0.15]), np.array([1e-4]), 0.0, sd) for sd in (0.08, 0.02))
    assert sharp.wear_var < wide.wear_var


@pytest.mark.parametrize("seed", range(3))
def test_clean_level_and_spread_come_back(model, seed):
    rng = np.random.default_rng(seed)
    packs = []
    for k in range(40):
        worn = rng.choice([0.0, 0.0, 0.03, 0.09, 0.2])
        offset = 0.07 + rng.normal(0.0, 0.045)
        packs.append(seen_flights(model, np.full(12, worn), offset=offset, seed=k, tail=f"S-{k:02d}"))
    found = fleet_levels(pl.concat(packs), NO_LOG, replace(model, clean_level=0.0))
    assert abs(found.clean_level - model.clean_level - 0.07) < 3.0 * found.clean_level_sd
    assert 0.03 < found.offset_sd < 0.07
    assert found.flight_sd == pytest.approx(model.flight_sd, abs=0.004)


def test_nothing_seen_changes_nothing(model):
    assert fleet_levels(seen_flights(model, np.zeros(0)), NO_LOG, model) == model


@pytest.mark.parametrize("wear", [0.0, 0.1, 0.4])
def test_a_deposit_in_series_is_brought_to_the_reference(wear):
    # conductances in series: 1/UA = 1/UA_clean + film, with the film that gives `wear` at the reference
    clean = np.array([1400.0, 1700.0, 2300.0])
    film = (np.exp(wear) - 1.0) / 1700.0
    ratio = -np.log1p(film * clean)
    none = np.zeros(3, dtype=int)
    seen = at_reference(Observation(ratio, np.ones(3), clean / 1700.0, none, none, none), np.full(3, wear))
    np.testing.assert_allclose(seen.ratio, -wear, atol=1e-12)
