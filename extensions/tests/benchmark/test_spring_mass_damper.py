"""The benchmark's oscillator: the filter is the Euler loop, and Euler tends to the exact answer."""

import numpy as np
import pytest

from hdt_benchmark.spring_mass_damper import SPRING_MASS_DAMPER, euler_position_m

TIME_S = np.arange(1001) * 0.01
FORCE_N = np.sin(2.0 * np.pi * 0.5 * TIME_S)


@pytest.mark.parametrize("params", [(0.5, 2.0, 1.0), (0.0, 5.0, 2.0), (3.0, 0.5, 0.7)])
def test_filter_is_the_euler_loop(params):
    damping, stiffness, mass = params
    values = {"damping_n_s_m": damping, "stiffness_n_m": stiffness, "mass_kg": mass}
    loop = SPRING_MASS_DAMPER.simulate(values, {"force_n": FORCE_N}, 0.01)["measured_m"]
    np.testing.assert_allclose(euler_position_m(FORCE_N, 0.01, *params), loop, atol=1e-11)


def test_euler_tends_to_the_closed_solution():
    """Constant force from rest, underdamped: x = F/k [1 - e^(-a t)(cos w t + a/w sin w t)]."""
    a = 0.25
    w = np.sqrt(2.0 - a**2)
    exact = 0.5 * (1.0 - np.exp(-a * 10.0) * (np.cos(w * 10.0) + a / w * np.sin(w * 10.0)))
    errors = [abs(euler_position_m(np.ones(10 * n + 1), 1.0 / n, 0.5, 2.0)[-1] - exact) for n in (1000, 2000)]
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.02)
    assert errors[1] < 2e-3


def test_ranges_are_those_on_paper():
    assert {p.name: (p.nominal, *p.bounds) for p in SPRING_MASS_DAMPER.params} == {
        "mass_kg": (1.0, 0.1, 10.0), "damping_n_s_m": (0.5, 0.0, 10.0), "stiffness_n_m": (2.0, 0.0, 50.0),
    }  # fmt: skip


def test_energy_is_kept_by_the_equation():
    """Without damper and force, the rate of change of energy is zero at every state."""
    rng = np.random.default_rng(0)
    x, v = rng.normal(size=(2, 100))
    velocity, acceleration = SPRING_MASS_DAMPER.rates(
        force_n=0.0, damping_n_s_m=0.0, stiffness_n_m=2.0, mass_kg=1.5, position_m=x, velocity_m_s=v
    )
    np.testing.assert_allclose(2.0 * x * velocity + 1.5 * v * acceleration, 0.0, atol=1e-14)


def test_signal_is_as_small_as_the_paper_s_figure():
    """Root mean square 0.127 m against a noise of 0.05 m: a ratio of 2.5 a sample."""
    assert np.sqrt(np.mean(euler_position_m(FORCE_N, 0.01, 0.5, 2.0) ** 2)) == pytest.approx(0.127, abs=0.001)
