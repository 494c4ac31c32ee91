"""The exchanger by its laws."""

import numpy as np
import pytest
from coolprop import PropsSI
from hypothesis import given
from hypothesis import strategies as st

from hdt_core.physics.air import mean_specific_heat_j_kg_k
from hdt_core.physics.effectiveness import crossflow_effectiveness
from hdt_core.physics.heat_exchanger import (
    HEAT_EXCHANGER,
    capacity_rates,
    clean_conductance_w_k,
    film_gains,
    measured_conductance_w_k,
    outlets_k,
)
from hdt_core.physics.installed_exchanger import DESIGN, NAMES, ln_clean_conductance

flows = st.floats(0.2, 3.0)
conductances = st.floats(100.0, 4000.0)
LAW = {
    "hx_ua_reference_w_k": 1500.0,
    "hx_exponent_hot": 0.6,
    "hx_exponent_cold": 0.6,
    "hx_hot_share": 0.5,
    "hx_wall_share": 0.0,
}


@given(flows, flows, st.floats(300.0, 480.0), st.floats(220.0, 290.0), conductances)
def test_heat_lost_is_heat_won_and_runs_downhill(hot_flow, ram_flow, hot_in, cold_in, ua):
    hot_out, ram_out = outlets_k(hot_flow, ram_flow, hot_in, cold_in, ua)
    hot_side_w = hot_flow * mean_specific_heat_j_kg_k(hot_in, hot_out) * (hot_in - hot_out)
    won = ram_flow * mean_specific_heat_j_kg_k(cold_in, ram_out) * (ram_out - cold_in)
    np.testing.assert_allclose(hot_side_w, won, rtol=1e-10)
    assert cold_in < hot_out < hot_in
    assert cold_in < ram_out < hot_in


@given(flows, flows, conductances)
def test_ua_comes_back_from_the_temperatures(hot_flow, ram_flow, ua):
    hot_out, _ = outlets_k(hot_flow, ram_flow, 390.0, 250.0, ua)
    if abs(measured_conductance_w_k(hot_flow, ram_flow, 390.0, hot_out - 1e-7, 250.0) / ua - 1.0) < 1e-6:
        assert measured_conductance_w_k(hot_flow, ram_flow, 390.0, hot_out, 250.0) == pytest.approx(ua, rel=1e-6)


@given(flows, flows)
def test_fouling_warms_the_hot_outlet_and_flow_cools_it(hot_flow, ram_flow):
    inputs = {"hot_flow_kg_s": hot_flow, "ram_flow_kg_s": ram_flow, "hot_in_k": 390.0, "cold_in_k": 250.0}
    out = HEAT_EXCHANGER.predict({"hx_fouling": np.linspace(-0.2, 0.8, 11)}, inputs)
    assert np.all(np.diff(out["hot_out_k"]) > 0.0)
    assert np.all(np.diff(out["ram_out_k"]) < 0.0)
    more = HEAT_EXCHANGER.predict({}, inputs | {"ram_flow_kg_s": 1.1 * ram_flow})
    assert more["hot_out_k"] < HEAT_EXCHANGER.predict({}, inputs)["hot_out_k"]


def test_conductance_follows_the_flows():
    """Balanced films of exponent 0.6: each side is worth 0.30 in ln UA, both 0.60."""
    step = 1e-6
    hot = np.log(clean_conductance_w_k(0.9 * (1 + step), 1.6, **LAW) / 1500.0) / step
    ram = np.log(clean_conductance_w_k(0.9, 1.6 * (1 + step), **LAW) / 1500.0) / step
    assert hot == pytest.approx(0.30, abs=1e-4)
    assert ram == pytest.approx(0.30, abs=1e-4)
    both = clean_conductance_w_k(1.8, 3.2, **LAW)
    assert both == pytest.approx(1500.0 * 2.0**0.6, rel=1e-12)


def test_films_gain_as_the_properties_of_air():
    """k^0.67 mu^-0.27 from CoolProp's properties, against the power law, over what a pack sees."""

    def film(temperature_k):
        conductivity, viscosity = (PropsSI(key, "T", temperature_k, "P", 1e5, "Air") for key in "LV")
        return conductivity**0.67 * viscosity**-0.27

    for hot_in_k, cold_in_k in [(340.0, 230.0), (390.0, 250.0), (440.0, 290.0)]:
        hot, cold = film_gains(hot_in_k, cold_in_k)
        assert hot == pytest.approx(film(0.75 * hot_in_k + 0.25 * cold_in_k) / film(355.0), abs=0.01)
        assert cold == pytest.approx(film(0.25 * hot_in_k + 0.75 * cold_in_k) / film(285.0), abs=0.01)


def test_a_wall_alone_does_not_care_for_flow():
    wall = LAW | {"hx_hot_share": 1e-12, "hx_wall_share": 1.0 - 2e-12}
    assert clean_conductance_w_k(0.3, 3.0, **wall) == pytest.approx(1500.0, rel=1e-9)


def test_what_a_loss_does_to_the_outlet():
    """Cross-flow, UA 1500 W/K, door fixed: 10 % moves the hot outlet by 3.7 K, 30 % by 13 K (docs/errata.md)."""
    nominal = outlets_k(0.9, 1.6, 390.0, 250.0, 1500.0)[0]
    assert outlets_k(0.9, 1.6, 390.0, 250.0, 1350.0)[0] - nominal == pytest.approx(3.7, abs=0.3)
    assert outlets_k(0.9, 1.6, 390.0, 250.0, 1050.0)[0] - nominal == pytest.approx(13.0, abs=1.0)


def test_impossible_temperatures_have_no_conductance():
    assert np.isnan(measured_conductance_w_k(0.9, 1.6, 390.0, 395.0, 250.0))
    assert np.isnan(measured_conductance_w_k(1.6, 0.9, 390.0, 290.0, 250.0))


def test_design_knowledge_is_that_on_paper():
    """Deviations as declared; of a share of resistance and a film's temperature, start and range too."""
    sds = (0.5, 0.05, 0.05, 0.3, 0.05, 0.15, 0.7, 0.4, 0.15, 0.25, 0.4, 0.1)
    assert tuple(p.sd for p in DESIGN) == sds
    own = {p.name: (p.nominal, *p.bounds) for p in DESIGN}
    assert own["hot_share_logit"] == (0.0, -1.5, 1.5)
    assert own["film_temperature_exponent"] == (0.15, -0.5, 0.8)
    assert own["ln_rest_area"] == pytest.approx(tuple(np.log((0.025, 0.0025, 0.6))))


def test_an_installed_core_conducts_by_the_mean_temperature_of_its_films():
    """Hot flow at twice 0.9 kg/s, ram flow at four times 1.6; films of 45 % of the resistance each, a wall of 10 %."""
    law = {"ln_ua_reference": np.log(1500.0), "hx_exponent_hot": 0.6, "hx_exponent_cold": 0.5, "hx_wall_share": 0.1}
    design = np.array([[(law | {"film_temperature_exponent": 0.7}).get(name, 0.0)] for name in NAMES])
    signals = {"pack_flow_kg_s": np.array([1.8]), "hx_in_k": np.array([450.0]), "tat_k": np.array([250.0])}
    resistance = 0.45 / 2.0**0.6 + 0.45 / 4.0**0.5 + 0.1
    expected = np.log(1500.0 / resistance) + 0.7 * np.log(350.0 / 325.0)
    assert ln_clean_conductance(signals, np.array([6.4]), design) == pytest.approx(expected)


@pytest.mark.parametrize(("hot_in_k", "cold_in_k", "ua_w_k"), [(390.0, 250.0, 1500.0), (450.0, 220.0, 4000.0)])
def test_outlets_settle_with_their_specific_heats_to_a_fifty_millionth_of_a_kelvin(hot_in_k, cold_in_k, ua_w_k):
    hot_k, _ = outlets_k(0.9, 1.6, hot_in_k, cold_in_k, ua_w_k)
    rate, ratio = capacity_rates(0.9, 1.6, hot_in_k, hot_k, cold_in_k)
    effectiveness = crossflow_effectiveness(ua_w_k / rate, ua_w_k / rate * ratio)
    assert hot_k == pytest.approx(hot_in_k - effectiveness * (hot_in_k - cold_in_k), abs=2e-8)
