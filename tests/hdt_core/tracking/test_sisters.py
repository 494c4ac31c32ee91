"""Sister units of a declared component: which level and spread they let expect of each, by hand."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from by_hand import flights, samples_of

from hdt_core.components import Component, Limit
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.tracking.sisters import CleanLevel, clean_levels, design_offset

PUMP = PhysicsModel(
    name="pump",
    inputs=(Signal("speed", "1/s"),),
    outputs=(Signal("lift", "m", sigma=0.01),),
    params=(
        Param("pmp_size", "m", 2.0, (0.5, 4.0), "design"),
        Param("pmp_loss", "-", 0.0, (-0.1, 0.9), "health", drift=0.01),
    ),
    equations=lambda speed, pmp_size, pmp_loss: pmp_size * speed * (1.0 - pmp_loss),
)
PART = Component("PMP", "pump", "lift lost", PUMP, "pmp_loss", Limit(0.3, 0.05, 0.05), 100.0, "look", new_share=0.9)


def design(levels: list[float]) -> pl.DataFrame:
    """Design rows of a fleet whose packs had these levels on their first flights."""
    rows = [("TST", f"T-{k:02d}", 1, "PMP", "pmp_level", level, 0.002) for k, level in enumerate(levels)]
    names = ["operator", "tail", "pack", "component", "parameter", "value", "sd"]
    return pl.DataFrame(rows, schema=names, orient="row")


def test_level_is_that_of_sisters():
    levels = [0.1, *[0.01 * (-1) ** k for k in range(12)]]

    first = clean_levels(design(levels), PART).row(0, named=True)

    assert first["level"] == pytest.approx(0.005, abs=0.01)
    assert first["level_sd"] < 0.01


@pytest.mark.parametrize("true_sd", [0.01, 0.06])
def test_recovers_spread_of_units(true_sd):
    levels = true_sd * np.random.default_rng(1).standard_normal(40)

    spread = clean_levels(design(levels.tolist()), replace(PART, new_share=0.99))["unit_sd"].median()

    assert spread == pytest.approx(true_sd, rel=0.35)


def test_worn_sisters_leave_level_alone():
    sound = [0.01, -0.01] * 6
    worn = [-0.2, -0.25]

    levels = clean_levels(design([*sound, *worn]), PART)

    assert levels["level"].to_list() == pytest.approx([0.0] * 14, abs=0.02)
    assert levels["unit_sd"].max() < 0.03


def test_lone_pack_has_no_sisters():
    assert clean_levels(design([0.1]), PART).is_empty()


@pytest.mark.parametrize(("level_sd", "shift"), [(1e-6, np.log(2.0 / 1.7) + 0.05), (1e6, 0.0)])
def test_offset_follows_surer_level(level_sd, shift):
    """A lift of 1.7 m by a design of 2 m; sisters lie .05 above that design."""
    samples = samples_of(flights(3, lift=1.7, speed=1.0), 5)
    own = PUMP.calibrated({"pmp_size": 1.7})

    offset = design_offset(samples, own, PART, CleanLevel(0.05, level_sd, 0.02))

    assert offset.shift == pytest.approx(shift, abs=1e-3)
