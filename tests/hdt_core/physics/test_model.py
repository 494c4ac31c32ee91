"""A declaration that contradicts itself is refused, and what it says can be asked of it."""

import numpy as np
import pytest

from hdt_benchmark.core_exchanger import CORE_EXCHANGER
from hdt_core.components.unmetered_exchanger import SPRAYED
from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from hdt_core.physics.installed_exchanger import RAM_DUCT
from hdt_core.physics.lumped_exchanger import lumped_exchanger
from hdt_core.physics.model import Param, PhysicsModel, Signal, State

MODELS = [
    COMPRESSOR, CORE_EXCHANGER, HEAT_EXCHANGER, RAM_DUCT, lumped_exchanger("quasi_steady"), lumped_exchanger("exact"),
    lumped_exchanger("euler"), lumped_exchanger("tustin"),
]  # fmt: skip
TYPICAL = {
    "force_n": 1.0, "hot_flow_kg_s": 0.9, "ram_flow_kg_s": 1.6, "hot_in_k": 390.0, "cold_in_k": 250.0,
    "cc_speed_rad_s": 3194.0, "cc_in_k": 251.0, "cc_in_pa": 37.6e3, "vda_counts": 300.0, "ram_door_open": 0.3,
    "total_pressure_pa": 37.6e3, "tat_k": 250.0, "altitude_m": 10668.0, "mach": 0.85,
}  # fmt: skip
each_model = pytest.mark.parametrize("model", MODELS, ids=lambda m: m.name)


def typical(model: PhysicsModel) -> dict[str, float]:
    return {s.name: TYPICAL[s.name] for s in model.inputs}


def scale_input(*, x, gain):
    return gain * x


@each_model
def test_outputs_broadcast_over_batches(model):
    some = model.params[0]
    batch = {some.name: np.array([[0.9], [1.0]]) * some.nominal}
    inputs = {name: np.full(3, value) for name, value in typical(model).items()}
    one = model.predict({some.name: 0.9 * some.nominal}, typical(model))
    for name, value in model.predict(batch, inputs).items():
        full = np.broadcast_to(value, (2, 3))
        np.testing.assert_allclose(full[0], one[name], rtol=1e-13)


@each_model
def test_nominal_values_lie_within_bounds(model):
    for param, (low, high) in zip(model.params, model.bounds(), strict=True):
        assert low < param.nominal < high or param.nominal == low == 0.0
        assert param.role == "design" or (param.nominal == 0.0 and low < 0.0 and param.drift > 0.0)


@each_model
def test_equations_differentiate_by_complex_step(model):
    """Every parameter's derivative: complex step against central differences."""
    for param in model.params:
        width = max(abs(param.nominal), 0.01)

        def outputs(value, name=param.name):
            states = {s.name: s.initial for s in model.states}
            if model.states:
                states = model.advance({name: value}, typical(model), states, 0.01)
                states = model.advance({name: value}, typical(model), states, 0.01)
            return np.array(list(model.predict({name: value}, typical(model), states).values()))

        exact = outputs(param.nominal + 1e-30j).imag / 1e-30
        step = 1e-6 * width
        central = (outputs(param.nominal + step) - outputs(param.nominal - step)) / (2.0 * step)
        scale = np.abs(outputs(param.nominal)) / width
        np.testing.assert_allclose(central, exact, rtol=1e-5, atol=1e-7 * float(np.max(scale)))


SENSORS = {
    "cc_speed_rad_s": (3.0, None, None), "cc_in_k": (0.5, 1.0, None), "cc_in_pa": (150.0, None, 0.003),
    "vda_counts": (5.0, None, None), "cc_flow_kg_s": (0.01, None, 0.02), "cc_out_pa": (400.0, None, 0.004),
    "cc_out_k": (0.7, None, None), "hot_flow_kg_s": (0.01, None, 0.02), "ram_flow_kg_s": (None, None, None),
    "hot_in_k": (0.4, 1.0, None), "hot_out_k": (0.4, 1.0, None), "ram_out_k": (0.4, 1.0, None),
    "cold_in_k": (0.3, 0.5, None), "tat_k": (0.3, 0.5, None), "altitude_m": (10.0, None, None),
    "ram_door_open": (0.006, 0.01, None), "total_pressure_pa": (40.0, None, 0.002), "mach": (0.002, None, None),
}  # fmt: skip
DESIGN = {
    "cc_area_diameter_tan_beta_m3": (7.6e-4, 1e-4, 5e-3, 4e-4), "cc_diameter_vda_intercept": (0.1731, 0.05, 0.5, 0.01),
    "cc_diameter_vda_slope": (-2.9304e-5, -3e-4, 3e-4, 2e-5), "cc_efficiency": (0.75, 0.4, 0.95, 0.05),
    "hx_core_heat_j_k": (18e3, 2e3, 100e3, None), "hx_ua_reference_w_k": (1700.0, 150.0, 8000.0, None),
    "hx_exponent_hot": (0.6, 0.3, 0.9, None), "hx_exponent_cold": (0.6, 0.3, 0.9, None),
    "hx_hot_share": (0.45, 0.1, 0.8, None), "hx_wall_share": (0.1, 0.0, 0.19, None),
    "ram_area_closed_m2": (0.003, 1.2e-4, 0.05, None), "ram_area_open_m2": (0.04, 0.0067, 0.6, None),
    "ram_door_low": (1.0 / 3.0, 0.02, 0.98, None), "ram_door_high": (0.6, 0.02, 0.98, None),
    "ram_core_area_m2": (0.05 / 2.0**0.5, 0.0035, 0.85, None), "ram_recovery": (0.8, 0.4, 1.0, None),
    "ram_exit_area_m2": (0.05 / 2.0**0.5, 0.0035, 0.85, None),
    "hx_h_hot_w_k": (2500.0, 1.0, 1e6, None), "hx_h_cold_w_k": (2500.0, 1.0, 1e6, None),
    "hxt_ntu": (1.6, 0.3, 8.0, 0.4), "hxt_exponent": (0.27, 0.0, 1.0, 0.05), "hxt_water_spray": (0.3, -0.2, 1.0, 0.2),
    "hx_mass_hot_kg": (8.0, 0.01, 50.0, None), "hx_mass_cold_kg": (8.0, 0.01, 50.0, None),
}  # fmt: skip
LOSSES = {
    "cc_diameter_loss": (-0.1, 0.5, 0.001, 0.04), "cc_efficiency_loss": (-0.1, 0.5, 0.001, 0.008),
    "hx_fouling": (-0.25, 0.9, 0.003, 0.04), "ram_flow_loss": (-0.1, 0.8, 0.002, None),
    "hx_h_loss": (-0.5, 0.95, 0.005, None), "hxt_loss": (-1.0, 0.95, 0.01, None),
}  # fmt: skip


INSTALLED = (COMPRESSOR, CORE_EXCHANGER, HEAT_EXCHANGER, RAM_DUCT)


def params_with(role: str) -> set[Param]:
    models = (*INSTALLED, lumped_exchanger("exact"), lumped_exchanger("tustin"), SPRAYED)
    return {p for m in models for p in m.params if p.role == role}


def test_sensors_match_paper():
    """Noise, bias and gain of each sensor."""
    sensors = {(s.name, (s.sigma, s.bias_sd, s.gain_sd)) for m in INSTALLED for s in (*m.inputs, *m.outputs)}
    assert sensors == set(SENSORS.items())


def test_design_ranges_match_paper():
    """Start, range and deviation of one aircraft."""
    design = {p.name: (p.nominal, *p.bounds, p.sd) for p in params_with("design")}
    assert design == {name: pytest.approx(value) for name, value in DESIGN.items()}


def test_loss_ranges_match_paper():
    """Range, drift and deviation of a unit as made."""
    assert {p.name: (*p.bounds, p.drift, p.unit_sd) for p in params_with("health")} == LOSSES


def test_textbook_sensors_match_paper():
    textbook = {s.name: s.sigma for s in (*lumped_exchanger("exact").inputs, *lumped_exchanger("exact").outputs)}
    assert textbook == {
        "hot_flow_kg_s": 0.01, "ram_flow_kg_s": None, "hot_in_k": 0.5, "cold_in_k": 0.2, "hot_out_k": 0.5,
        "ram_out_k": 0.5,
    }  # fmt: skip


def test_sprayed_outlet_has_declared_noise():
    assert [s.sigma for s in SPRAYED.outputs] == [3.0]


def test_roles_divide_the_parameters():
    health = {p.name for p in COMPRESSOR.free("health")}
    design = {p.name for p in COMPRESSOR.free("design")}
    assert health == {"cc_diameter_loss", "cc_efficiency_loss"}
    assert not health & design
    assert health | design == set(COMPRESSOR.nominal)
    assert COMPRESSOR.bounds("health").shape == (2, 2)


def test_calibrated_model_changes_values_alone():
    sold = HEAT_EXCHANGER.calibrated({"hx_ua_reference_w_k": 1800.0})
    assert sold.nominal == {**HEAT_EXCHANGER.nominal, "hx_ua_reference_w_k": 1800.0}
    assert HEAT_EXCHANGER.nominal["hx_ua_reference_w_k"] == 1700.0


def test_unknown_parameter_is_refused():
    with pytest.raises(KeyError, match="no parameter ua"):
        HEAT_EXCHANGER.calibrated({"ua": 1.0})


def test_missing_input_is_refused():
    with pytest.raises(KeyError, match="mach"):
        RAM_DUCT.predict({}, {k: v for k, v in typical(RAM_DUCT).items() if k != "mach"})


@pytest.mark.parametrize(("name", "equations"), [("gain", scale_input), ("slope", lambda *, slope, **values: slope)])
def test_undeclared_argument_is_refused(name, equations):
    with pytest.raises(ValueError, match=f"differ in {name}"):
        PhysicsModel("m", (Signal("x", "-"),), (Signal("y", "-"),), (), equations)


@pytest.mark.parametrize(("upper", "is_share"), [(0.999, True), (1.0, False), (1.1, False)])
def test_share_stays_below_one(upper, is_share):
    assert Param("loss", "-", 0.0, (-0.1, upper), "health").is_share is is_share


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"inputs": (Signal("x", "-"), Signal("x", "-"))}, "declared twice: x"),
        ({"states": (State("x", "-", 0.0),), "inputs": ()}, "states and rates"),
    ],
)
def test_contradictory_model_is_refused(change, message):
    gain = Param("gain", "-", 1.0, (0.0, 2.0), "design")
    parts = {"inputs": (Signal("x", "-"),), "outputs": (Signal("y", "-"),), "params": (gain,)}
    with pytest.raises(ValueError, match=message):
        PhysicsModel("m", equations=scale_input, **(parts | change))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3.0, (0.0, 2.0), "design"), "outside its bounds"), ((-0.1, (0.0, 2.0), "design"), "outside its bounds"),
        ((0.0, (0.0, 2.0), "health"), "below 0"), ((-0.1, (-1.0, 2.0), "health"), "below 0"),
        ((1.0, (0.0, 2.0), "design", 0.0, 0.0), "is none"), ((0.0, (-1.0, 2.0), "health", -0.1), "negative"),
    ],
)  # fmt: skip
def test_impossible_parameter_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Param("p", "-", *arguments)


@pytest.mark.parametrize("nominal", [0.0, 2.0])
def test_parameter_may_start_at_bound(nominal):
    assert Param("p", "-", nominal, (0.0, 2.0), "design").nominal == nominal
