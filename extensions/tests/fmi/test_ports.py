"""Components joined by ports say what the components say one after another."""

import numpy as np
import pytest

from hdt_benchmark.core_exchanger import CORE_EXCHANGER
from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from hdt_core.physics.installed_exchanger import RAM_DUCT
from hdt_core.physics.model import Signal
from hdt_fmi.ports import PACK, compose

AIR = {"tat_k": 250.0, "mach": 0.85, "total_pressure_pa": 37.6e3, "altitude_m": 10668.0}
STATION = {"cc_speed_rad_s": 3194.0, "cc_in_k": 251.0, "cc_in_pa": 37.6e3, "vda_counts": 300.0}
FLIGHT = AIR | STATION | {"ram_door_open": np.array([0.1, 0.3, 0.9])}
WIRES = {
    "heat_exchanger.hot_in_k": "compressor.cc_out_k",
    "heat_exchanger.hot_flow_kg_s": "compressor.cc_flow_kg_s",
    "heat_exchanger.ram_flow_kg_s": "ram_duct.ram_flow_kg_s",
    "heat_exchanger.cold_in_k": "tat_k",
}


def one_after_another(params):
    cc = COMPRESSOR.predict(params, FLIGHT)
    duct = RAM_DUCT.predict(params, FLIGHT)
    inputs = {"hot_in_k": cc["cc_out_k"], "hot_flow_kg_s": cc["cc_flow_kg_s"], "cold_in_k": FLIGHT["tat_k"]}
    inputs["ram_flow_kg_s"] = duct["ram_flow_kg_s"]
    return cc | duct | HEAT_EXCHANGER.predict(params, inputs)


@pytest.mark.parametrize("worn", ["hx_fouling", "ram_flow_loss", "cc_efficiency_loss", "cc_diameter_loss"])
def test_pack_equals_parts_in_order(worn):
    together = PACK.predict({worn: 0.2}, FLIGHT)
    apart = one_after_another({worn: 0.2})
    assert together.keys() == apart.keys()
    for name in apart:
        np.testing.assert_allclose(together[name], apart[name], rtol=1e-14)


@pytest.mark.parametrize("wear", [{"cc_efficiency_loss": 0.1}, {"ram_flow_loss": 0.3}])
def test_wear_upstream_reaches_exchanger(wear):
    clean = PACK.predict({}, FLIGHT)
    worn = PACK.predict(wear, FLIGHT)
    assert np.all(worn["hot_out_k"] > clean["hot_out_k"])


def test_worn_compressor_delivers_hotter_air():
    clean = PACK.predict({}, FLIGHT)
    worn = PACK.predict({"cc_efficiency_loss": 0.1}, FLIGHT)
    assert np.all(worn["cc_out_k"] > clean["cc_out_k"] + 5.0)


def test_pack_declares_only_unfed_inputs():
    assert {s.name for s in PACK.inputs} == set(FLIGHT)
    assert len(PACK.params) == len(COMPRESSOR.params) + len(RAM_DUCT.params) + len(HEAT_EXCHANGER.params)
    assert Signal("tat_k", "K", sigma=0.3, bias_sd=0.5) in PACK.inputs


def test_states_travel_with_component():
    """With the storing core in the pack, a long hold ends where the steady pack is."""
    pack = compose("pack", (COMPRESSOR, RAM_DUCT, CORE_EXCHANGER), WIRES)
    hold = FLIGHT | {"ram_door_open": np.full(200, 0.3)}
    simulated = pack.simulate({}, hold, 1.0)
    steady = PACK.predict({}, FLIGHT | {"ram_door_open": 0.3})
    assert abs(simulated["hot_out_k"][0] - steady["hot_out_k"]) > 1.0
    np.testing.assert_allclose(simulated["hot_out_k"][-1], steady["hot_out_k"], rtol=1e-9)
    rates = pack.rates(**pack.nominal, **(FLIGHT | {"ram_door_open": 0.3}), core_k=300.0)
    assert len(rates) == 1


@pytest.mark.parametrize(
    ("parts", "wires", "message"),
    [
        ((HEAT_EXCHANGER, COMPRESSOR), {"heat_exchanger.hot_in_k": "compressor.cc_out_k"}, "no earlier part"),
        ((COMPRESSOR, HEAT_EXCHANGER), {"heat_exchanger.hot_k": "compressor.cc_out_k"}, "no such input port"),
        ((COMPRESSOR, HEAT_EXCHANGER), {"heat_exchanger.hot_in_k": "compressor.exit_k"}, "no earlier part"),
        ((HEAT_EXCHANGER, HEAT_EXCHANGER), {}, "two parts put out"),
    ],
)
def test_wrong_wiring_is_refused(parts, wires, message):
    with pytest.raises(ValueError, match=message):
        compose("pack", parts, wires)
