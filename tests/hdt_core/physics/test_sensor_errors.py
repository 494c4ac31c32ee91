"""Declared calibration errors of sensors, as parameters of a model that the calibration frees."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration.component_fit import calibrate_with_sensors
from hdt_core.estimation import estimators
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.physics.sensor_errors import with_sensor_errors

DUCT = PhysicsModel(
    name="duct",
    inputs=(Signal("in_k", "K", bias_sd=1.0),),
    outputs=(Signal("out_k", "K", sigma=0.5, bias_sd=1.0, gain_sd=0.01), Signal("wall_k", "K", sigma=0.5)),
    params=(Param("gain", "-", 2.0, (0.1, 9.0), "design"), Param("loss", "-", 0.0, (-0.1, 0.9), "health")),
    equations=lambda in_k, gain, loss: (gain * (1.0 - loss) * in_k, in_k),
)


@pytest.mark.parametrize(
    ("error", "out_k", "wall_k"),
    [({"bias_in_k": 1.0}, 18.0, 9.0), ({"bias_out_k": 1.0}, 21.0, 10.0), ({"gain_out_k": 0.1}, 22.0, 10.0)],
)
def test_error_shifts_its_own_signal(error, out_k, wall_k):
    predicted = with_sensor_errors(DUCT).predict(error, {"in_k": 10.0})

    assert (predicted["out_k"], predicted["wall_k"]) == pytest.approx((out_k, wall_k))


def test_errors_have_declared_prior():
    errors = with_sensor_errors(DUCT).free("design")[1:]

    assert {p.name: p.sd for p in errors} == {"bias_in_k": 1.0, "bias_out_k": 1.0, "gain_out_k": 0.01}


def test_model_without_errors_is_unchanged():
    plain = PhysicsModel("p", (Signal("x", "K"),), (Signal("y", "K", sigma=1.0),), (), lambda x: x)

    assert with_sensor_errors(plain) is plain


def record(bias_k: float, flight_sd_k: float = 0.0) -> pl.DataFrame:
    """Twenty flights of ten samples, the outlet's sensor off by so much, and each flight's outlet by its own."""
    rng = np.random.default_rng(1)
    flight = np.repeat(np.arange(20), 10)
    in_k = 10.0 + rng.standard_normal(200)
    own_k = flight_sd_k * rng.standard_normal(20)[flight]
    keys = {"operator": "TST", "tail": "T-1", "pack": 1, "flight_id": flight.astype(str)}
    values = {"in_k": in_k, "out_k": 2.0 * in_k + bias_k + own_k, "wall_k": in_k}
    return pl.DataFrame(keys | {n: v + 0.5 * rng.standard_normal(200) if n != "in_k" else v for n, v in values.items()})


@pytest.mark.parametrize("method", ["nls", "pso", "ekf", "ukf", "pinn"])
def test_estimators_allow_for_declared_errors(method):
    """A probe that reads 1 K high would make a gain of 2 one of 2.1, sixty times the samples' own deviation."""
    _, estimate = calibrate_with_sensors(DUCT, record(bias_k=1.0), estimators()[method])

    gain = estimate.belief.mean[0]
    sd = estimate.belief.sd[0]
    assert abs(gain - 2.0) < 2.0 * sd < 0.3


def test_flight_samples_share_an_error():
    exact = replace(DUCT, inputs=(Signal("in_k", "K"),), outputs=(Signal("out_k", "K", sigma=0.5), DUCT.outputs[1]))

    sds = [calibrate_with_sensors(exact, record(0.0, own_k))[1].belief.sd[0] for own_k in (0.0, 1.0)]

    assert sds[1] / sds[0] == pytest.approx((1.0 + 10.0 * 1.0**2 / 0.5**2) ** 0.5, rel=0.3)
