"""Terms that a model may lack: what they do is undone exactly, and the library is sound."""

import numpy as np
import pytest
from coolprop import PropsSI

from hdt_core.physics.terms import TERMS, correct_signals, record_signals, saturation_pressure_pa, within

TRUTH = {
    "altitude_m": np.array([9500.0, 11000.0]),
    "mach": np.array([0.80, 0.85]),
    "tat_k": np.array([243.0, 262.0]),
    "total_pressure_pa": np.array([44e3, 36e3]),
    "hx_in_k": np.array([380.0, 410.0]),
    "hx_out_k": np.array([292.0, 301.0]),
    "pack_flow_kg_s": np.array([0.7, 0.85]),
}


@pytest.mark.parametrize("name", TERMS)
def test_what_sensors_record_is_turned_back(name):
    recorded = record_signals(TRUTH, {name: 0.1})
    signal = TERMS[name].signal
    assert np.all(np.abs(recorded[signal] - TRUTH[signal]) > 0.0)
    back = correct_signals(recorded, {name: 0.1})
    for of, values in TRUTH.items():
        np.testing.assert_allclose(back[of], values, rtol=1e-12)


def test_without_a_term_nothing_changes():
    assert correct_signals(TRUTH, {}) == TRUTH
    assert TERMS["water_spray"].name == "water_spray"
    with pytest.raises(KeyError):
        correct_signals(TRUTH, {"unheard_of": 1.0})


def test_vapour_pressure_is_water_s():
    for temperature_k in (275.0, 290.0, 320.0):
        assert saturation_pressure_pa(temperature_k) == pytest.approx(
            PropsSI("P", "T", temperature_k, "Q", 0, "Water"), rel=5e-3
        )


def test_shapes_and_bounds_on_paper():
    """Vapour of 2.5 MJ/kg in air of 1005 J/kg/K, 0.622 kg a kg of it by pressure; a cabin of 80 kPa; 390 K."""
    outside_pa = np.array([285.24e2, 226.32e2])
    shapes = {
        "water_spray": 2.5e6 / 1005.0 * 0.622 * saturation_pressure_pa(TRUTH["tat_k"]) / TRUTH["total_pressure_pa"],
        "flow_leak": TRUTH["pack_flow_kg_s"] * (1.0 - outside_pa / 80e3),
        "inlet_gain": TRUTH["hx_in_k"] - 390.0, "outlet_conduction": TRUTH["tat_k"] - TRUTH["hx_out_k"],
    }  # fmt: skip
    assert {name: term.shape(TRUTH) for name, term in TERMS.items()} == {
        name: pytest.approx(shape, rel=1e-3) for name, shape in shapes.items()
    }
    assert [term.bounds for term in TERMS.values()] == [(-0.5, 1.0), *[(-0.5, 0.5)] * 3]
    assert within("water_spray", 7.0) == 1.0
    assert within("water_spray", -7.0) == -0.5
    assert within("inlet_gain", 0.07) == 0.07
