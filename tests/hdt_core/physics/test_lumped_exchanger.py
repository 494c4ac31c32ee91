"""Equations (7)-(8), the forms against each other and the wall they cannot pass."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from hdt_core.estimation import NonlinearLeastSquares
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.heat_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K, outlets_k
from hdt_core.physics.lumped_exchanger import (
    effectiveness_ceiling,
    lumped_exchanger,
    rates_k_s,
    steady_outlets_k,
    tied_coefficient_w_k,
)

AT = {"hot_flow_kg_s": 0.9, "ram_flow_kg_s": 1.6, "hot_in_k": 390.0, "cold_in_k": 250.0}
START_K = {"hot_volume_k": 350.0, "cold_volume_k": 260.0}
flows = st.floats(0.3, 3.0)
coefficients = st.floats(200.0, 20000.0)


each_tied_exchanger = given(flows, flows, coefficients)


def tied_outlets(hot_flow, ram_flow, h):
    at = AT | {"hot_flow_kg_s": hot_flow, "ram_flow_kg_s": ram_flow}
    return at, *steady_outlets_k(**at, hx_h_hot_w_k=h, hx_h_cold_w_k=h)


@each_tied_exchanger
def test_tied_coefficient_inverts_outlets(hot_flow, ram_flow, h):
    at, hot_out, _ = tied_outlets(hot_flow, ram_flow, h)
    assert tied_coefficient_w_k(**at, hot_out_k=hot_out) == pytest.approx(h, rel=1e-8)


@each_tied_exchanger
def test_tied_coefficients_balance_heat(hot_flow, ram_flow, h):
    _, hot_out, ram_out = tied_outlets(hot_flow, ram_flow, h)
    loss_w = hot_flow * CP_HOT_J_KG_K * (390.0 - hot_out)
    assert loss_w == pytest.approx(ram_flow * CP_COLD_J_KG_K * (ram_out - 250.0), rel=1e-11)


def test_rates_follow_equations_7_8():
    """Heat through the core over c_p, and 70 K lost and 40 K won by streams of 0.9 and 1.6 kg/s, over the masses."""
    more = {"hx_h_hot_w_k": 2500.0, "hx_h_cold_w_k": 2000.0, "hx_mass_hot_kg": 5.0, "hx_mass_cold_kg": 8.0}
    hot, cold = rates_k_s(**AT, **more, hot_volume_k=320.0, cold_volume_k=290.0)
    assert hot == pytest.approx((0.9 * 70.0 - 2500.0 * 30.0 / CP_HOT_J_KG_K) / 5.0)
    assert cold == pytest.approx((-1.6 * 40.0 + 2000.0 * 30.0 / CP_COLD_J_KG_K) / 8.0)


def offset_after_one_second(form):
    """From the steady state, with the mass of the air alone. [K]"""
    gas = {"hx_mass_hot_kg": 0.03, "hx_mass_cold_kg": 0.03}
    steady = lumped_exchanger("quasi_steady").predict({}, AT)["hot_out_k"]
    return abs(lumped_exchanger(form).advance(gas, AT, START_K, 1.0)["hot_volume_k"] - steady)


def test_exact_form_settles_light_volumes():
    assert offset_after_one_second("exact") < 1e-9


def test_euler_form_loses_light_volumes():
    assert offset_after_one_second("euler") > 100.0


def test_parameters_are_as_published():
    coefficient = (2500.0, (1.0, 1e6), "design", 0.0)
    mass = (8.0, (0.01, 50.0), "design", 0.0)
    assert [(p.nominal, p.bounds, p.role, p.drift) for p in lumped_exchanger().params] == [
        coefficient, coefficient, (0.0, (-0.5, 0.95), "health", 0.005), mass, mass
    ]  # fmt: skip


def test_sensors_are_as_published():
    model = lumped_exchanger()
    assert [s.sigma for s in (*model.inputs, *model.outputs)] == [0.01, None, 0.5, 0.2, 0.5, 0.5]


def test_states_start_as_published():
    starts = [(s.name, s.initial) for s in lumped_exchanger().states]
    assert starts == [("hot_volume_k", 320.0), ("cold_volume_k", 290.0)]


def test_untied_coefficients_break_the_balance():
    hot_out, ram_out = steady_outlets_k(**AT, hx_h_hot_w_k=2500.0, hx_h_cold_w_k=2000.0)
    assert 0.9 * CP_HOT_J_KG_K * (390.0 - hot_out) > 1.2 * 1.6 * CP_COLD_J_KG_K * (ram_out - 250.0)


@given(flows, flows)
def test_effectiveness_has_a_ceiling(hot_flow, ram_flow):
    at = AT | {"hot_flow_kg_s": hot_flow, "ram_flow_kg_s": ram_flow}
    hot_out, _ = steady_outlets_k(**at, hx_h_hot_w_k=1e12, hx_h_cold_w_k=1e12)
    ceiling = effectiveness_ceiling(hot_flow * CP_HOT_J_KG_K, ram_flow * CP_COLD_J_KG_K)
    assert (390.0 - hot_out) / 140.0 == pytest.approx(ceiling, rel=1e-6)


@pytest.mark.parametrize(("ua", "h"), [(800.0, 2140.0), (1200.0, 13651.0), (1327.0, None), (2500.0, None)])
def test_efficient_exchanger_has_no_coefficient(ua, h):
    """Wh 0.9, Wr 1.6 kg/s: the tied H of a cross-flow exchanger, which ends below zero (docs/errata.md)."""
    hot_out, _ = outlets_k(0.9, 1.6, 390.0, 250.0, ua)
    tied_w_k = tied_coefficient_w_k(**AT, hot_out_k=hot_out)
    assert tied_w_k < 0.0 if h is None else tied_w_k == pytest.approx(h, rel=1e-3)


def matrix(h_hot, h_cold, m_hot, m_cold):
    return np.array(
        [
            [-0.9 / m_hot - h_hot / (m_hot * CP_HOT_J_KG_K), h_hot / (m_hot * CP_HOT_J_KG_K)],
            [h_cold / (m_cold * CP_COLD_J_KG_K), -1.6 / m_cold - h_cold / (m_cold * CP_COLD_J_KG_K)],
        ]
    )


@given(coefficients, coefficients, st.floats(0.05, 20.0), st.floats(0.05, 20.0), st.floats(0.001, 5.0))
def test_exact_form_is_matrix_exponential(h_hot, h_cold, m_hot, m_cold, dt_s):
    params = {"hx_h_hot_w_k": h_hot, "hx_h_cold_w_k": h_cold, "hx_mass_hot_kg": m_hot, "hx_mass_cold_kg": m_cold}
    later = lumped_exchanger("exact").advance(params, AT, START_K, dt_s)
    steady = np.array(steady_outlets_k(**AT, hx_h_hot_w_k=h_hot, hx_h_cold_w_k=h_cold))
    expected = steady + expm(matrix(h_hot, h_cold, m_hot, m_cold) * dt_s) @ (np.array(list(START_K.values())) - steady)
    np.testing.assert_allclose(list(later.values()), expected, rtol=1e-10)


@pytest.mark.parametrize(("form", "order"), [("euler", 1), ("tustin", 2)])
def test_sequential_forms_keep_their_order(form, order):
    def after_one_second(form, steps):
        hold = AT | {"ram_flow_kg_s": np.full(steps + 1, 1.6)}
        return lumped_exchanger(form).simulate({}, hold, 1.0 / steps, START_K)["hot_out_k"][-1]

    exact = after_one_second("exact", 1)
    coarse, fine = (abs(after_one_second(form, n) - exact) for n in (8, 16))
    assert coarse / fine == pytest.approx(2.0**order, rel=0.1)


@pytest.mark.parametrize("form", ["quasi_steady", "exact", "euler", "tustin"])
def test_loss_lowers_both_coefficients(form):
    model = lumped_exchanger(form)
    hold = AT | {"ram_flow_kg_s": np.full(5, 1.6)}
    worn = model.simulate({"hx_h_loss": 0.2}, hold, 1.0)["hot_out_k"]
    smaller = model.simulate({"hx_h_hot_w_k": 2000.0, "hx_h_cold_w_k": 2000.0}, hold, 1.0)["hot_out_k"]
    np.testing.assert_allclose(worn, smaller, rtol=1e-14)
    assert [p.name for p in model.free("health")] == ["hx_h_loss"]


@pytest.mark.parametrize("form", ["exact", "tustin"])
def test_recovers_both_coefficients(form):
    """A minute at 1 Hz with a step of the door, simulated without noise."""
    seconds = np.arange(60.0)
    model = lumped_exchanger(form)
    inputs = AT | {"ram_flow_kg_s": 1.6 + 0.3 * (seconds > 30.0), "hot_in_k": 390.0 + 3.0 * np.sin(seconds / 9.0)}
    inputs = {name: np.broadcast_to(value, 60) for name, value in inputs.items()}
    truth = {"hx_h_hot_w_k": 2300.0, "hx_h_cold_w_k": 1900.0}
    measured = {"hot_out_k": model.simulate(truth, inputs, 1.0)["hot_out_k"]}
    fit = NonlinearLeastSquares().estimate(declared_problem(model, tuple(truth), inputs, measured))
    np.testing.assert_allclose(fit.belief.mean, list(truth.values()), rtol=1e-5)
    assert fit.status == "converged"
