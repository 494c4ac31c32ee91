"""Redundant outputs of a declared component: two gauges that a loss moves apart, and one of which shifts."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from by_hand import flights, samples_of

from hdt_core.calibration.component_fit import flight_by_flight
from hdt_core.components import Component, Limit
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.physics.sensor_errors import with_sensor_errors
from hdt_core.tracking.redundancy import sensor_shifts

GAUGES = PhysicsModel(
    name="gauges",
    inputs=(Signal("load", "-"),),
    outputs=(Signal("upper", "-", sigma=0.02, bias_sd=0.1), Signal("lower", "-", sigma=0.02, bias_sd=0.1)),
    params=(Param("gau_size", "-", 1.0, (0.1, 9.0), "design"), Param("gau_loss", "-", 0.0, (-0.5, 0.9), "health")),
    equations=lambda load, gau_size, gau_loss: (load * (gau_size + gau_loss), load * (gau_size - gau_loss)),
)
PART = Component("GAU", "gauges", "size lost", GAUGES, "gau_loss", Limit(0.4, 0.05, 0.05), 1000.0, "look")
SHIFTED = 60
ALL = 100


def shifted_flights(part: Component, shift: float, loss_step: float = 0.0) -> pl.DataFrame:
    """Flights whose upper gauge reads `shift` high from the sixtieth on, and whose loss makes a step there."""
    rng = np.random.default_rng(1)
    late = np.repeat(np.arange(ALL) >= SHIFTED, 6)
    noise = 0.02 * rng.standard_normal((2, 6 * ALL))
    upper = 1.0 + (shift + loss_step) * late + noise[0]
    lower = 1.0 - loss_step * late + noise[1]
    rows = samples_of(flights(ALL, load=1.0), 6).with_columns(upper=pl.Series(upper), lower=pl.Series(lower))
    model = with_sensor_errors(part.model)
    return sensor_shifts(flight_by_flight(rows, model, ["gau_loss"]), rows, model, part)


def test_shift_is_removed_from_loss():
    """A gauge that reads 0.2 high feigns half of that."""
    rows = shifted_flights(PART, 0.2)

    assert rows["sensor_shift"][-20:].mean() == pytest.approx(0.1, abs=0.02)
    assert rows["sensor_shift_sd"][-1] < 0.03


def test_flights_before_shift_stay():
    rows = shifted_flights(PART, 0.2)

    assert rows[:SHIFTED].select("sensor_shift", "sensor_shift_sd").sum().row(0) == (0.0, 0.0)


def test_loss_step_is_no_shift():
    assert shifted_flights(PART, 0.0, loss_step=0.2)["sensor_shift_sd"].max() == 0.0


def test_small_shift_is_no_fault():
    """It is left to the declared error."""
    assert shifted_flights(PART, 0.03)["sensor_shift_sd"].max() == 0.0


def test_single_output_shows_no_shift():
    upper = replace(
        GAUGES, outputs=(GAUGES.outputs[0],), equations=lambda load, gau_size, gau_loss: gau_size + gau_loss
    )

    assert shifted_flights(replace(PART, model=upper), 0.2)["sensor_shift_sd"].max() == 0.0
