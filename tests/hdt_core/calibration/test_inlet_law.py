"""The hot inlet follows discharge and ram outlet; the core's film leaves the law alone, its sensors do not."""

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.inlet_law import full_open_inlet_k, inlet_above_law, learn_inlet
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s

EFFECTIVENESS = 0.4


@pytest.fixture(scope="module")
def flown(fleet, model):
    """Cruise of a fleet whose hot inlet is what a first exchanger in the same ram air leaves of the discharge."""
    cruise = cruise_samples(fleet.samples).drop_nulls(list(hx.SIGNALS))
    rng = np.random.default_rng(5)
    bias = model.bias_of(cruise)
    signals = hx.without_bias({n: cruise[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias)
    discharge_k = 470.0 + 0.8 * (signals["tat_k"] - 250.0) + 8.0 * rng.standard_normal(cruise.height)
    inlet_k = behind_first_exchanger(signals, discharge_k, model) + bias[hx.BIASES.index("hx_in_k")]
    return cruise.with_columns(
        pl.Series("cc_out_k", discharge_k), pl.Series("hx_in_k", inlet_k + 0.3 * rng.standard_normal(cruise.height))
    )


def behind_first_exchanger(signals, discharge_k, model):
    """Inlet = (1 - e) discharge + e ram outlet + 40 K of the air cycle machine; the ram outlet holds the inlet."""
    share = signals["pack_flow_kg_s"] / clean_ram_flow_kg_s(signals, model.design)
    ram_less_inlet_k = signals["tat_k"] - share * signals["hx_out_k"]
    inlet_k = (1.0 - EFFECTIVENESS) * discharge_k + EFFECTIVENESS * ram_less_inlet_k + 40.0
    return inlet_k / (1.0 - EFFECTIVENESS * share)


def above(cruise, model, slopes):
    return inlet_above_law(cruise, slopes, model.design, model.bias_of(cruise)).sort("tail", "pack", "flight_id")


def spread(frame):
    value = pl.col("inlet_apart_k")
    return frame.select((value - value.median().over("tail", "pack")).abs().median()).item()


@pytest.fixture(scope="module")
def slopes(flown, model):
    return learn_inlet(flown, model.design, model.bias_of(flown))


def test_the_law_is_learned_and_holds(flown, model, slopes):
    assert slopes[0] == pytest.approx(1.0 - EFFECTIVENESS, abs=0.1)
    assert spread(above(flown, model, slopes)) < 0.5


@pytest.mark.parametrize(("sensor", "error", "least"), [("hx_in_k", 4.0, 1.5), ("cc_out_k", -4.0, 1.5)])
def test_a_sensor_that_is_off_leaves_the_law(flown, model, slopes, sensor, error, least):
    above_law = above(flown.with_columns(pl.col(sensor) + error), model, slopes)
    shift = above_law["inlet_apart_k"] - above(flown, model, slopes)["inlet_apart_k"]
    assert shift.median() > least


def test_a_flight_without_discharge_temperature_is_judged_by_its_pressure_ratio(flown, model, slopes):
    silent = flown.with_columns(cc_out_k=pl.lit(None, pl.Float64))
    assert above(silent, model, slopes)["inlet_apart_k"].is_not_null().all()


def test_with_the_door_full_open_the_inlet_is_as_cool_as_the_heat_balance_has_it(flown, model, slopes):
    bias = model.bias_of(flown)
    signals = hx.without_bias({n: flown[n].to_numpy().astype(float) for n in hx.SIGNALS}, bias)
    full = signals | {"ram_door_open": np.ones(flown.height)}
    truth_k = behind_first_exchanger(full, flown["cc_out_k"].to_numpy(), model)
    found_k = full_open_inlet_k(flown, slopes, model.design, bias, signals["hx_out_k"])
    found_k = found_k - bias[hx.BIASES.index("hx_in_k")]
    shut = signals["ram_door_open"] < 0.5
    assert np.median(signals["hx_in_k"][shut] - truth_k[shut]) > 8.0, "what is at stake"
    assert np.median(np.abs(found_k - truth_k)) < 2.0
    assert np.quantile(np.abs(found_k - truth_k)[shut], 0.9) < 5.0


def test_without_a_law_or_a_discharge_the_inlet_is_as_recorded(flown, model, slopes):
    bias, held_k = model.bias_of(flown), flown["hx_out_k"].to_numpy()
    recorded = flown["hx_in_k"].to_numpy()
    np.testing.assert_array_equal(full_open_inlet_k(flown, (), model.design, bias, held_k), recorded)
    blind = flown.with_columns(cc_out_k=pl.lit(None, pl.Float64), cc_out_pa=pl.lit(None, pl.Float64))
    np.testing.assert_array_equal(full_open_inlet_k(blind, slopes, model.design, bias, held_k), recorded)


def test_nothing_is_said_without_a_law(flown, model):
    assert learn_inlet(flown.head(20), model.design, model.bias_of(flown.head(20))) == ()
    assert above(flown, model, ())["inlet_apart_k"].is_null().all()
