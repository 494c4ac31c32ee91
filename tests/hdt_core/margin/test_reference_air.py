"""The ISA by hand: 216.65 K above 11 km, where pressure falls by exp(-g h / R T)."""

import numpy as np
import pytest

from hdt_core.margin.reference_air import hot_day_tat_k, reference_air

RAM_K = 1.0 + 0.2 * 0.84**2


def test_reference_cruise_is_11_km_at_mach_84():
    air = {name: values.tolist() for name, values in reference_air(2).items()}
    assert air["altitude_m"] == [11_000.0] * 2
    assert air["mach"] == [0.84] * 2
    assert air["tat_k"] == pytest.approx([216.65 * RAM_K] * 2)
    assert air["total_pressure_pa"] == pytest.approx([22_632.0 * RAM_K**3.5] * 2, rel=1e-4)


def test_another_level_has_its_own_pressure():
    static_pa = 22_632.0 * np.exp(-9.80665 * (12_497.0 - 11_000.0) / (287.053 * 216.65))
    assert reference_air(1, 12_497.0)["total_pressure_pa"][0] == pytest.approx(static_pa * RAM_K**3.5, rel=1e-4)


def test_hot_day_is_15_k_above_the_standard():
    standard_k = 288.15 - 0.0065 * 9000.0
    hot = hot_day_tat_k(np.array([9000.0]), np.array([0.8]))
    assert hot[0] == pytest.approx((standard_k + 15.0) * (1.0 + 0.2 * 0.8**2))
