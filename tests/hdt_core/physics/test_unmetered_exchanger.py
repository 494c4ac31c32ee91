"""An exchanger whose flows nobody measures, by its equation and the air's own."""

import numpy as np
import pytest

from hdt_core.physics.terms import TERMS
from hdt_core.physics.unmetered_exchanger import SPRAYED, UNMETERED, effectiveness, ram_flux_kg_s_m2

INPUTS = {"hot_in_k": 400.0, "tat_k": 290.0, "total_pressure_pa": 90e3, "ram_flux_kg_s_m2": 150.0}
CORE = {"hxt_ntu": 1.5, "hxt_exponent": 0.3, "hxt_loss": 0.1}
LEFT = np.exp(-0.9 * 1.5 * 1.5**0.3)


def test_the_outlet_follows_the_airspeed_and_spray_cools_the_air():
    assert UNMETERED.predict(CORE, INPUTS)["hot_out_k"] == pytest.approx(290.0 + 110.0 * LEFT)
    room_k = TERMS["water_spray"].shape(INPUTS)
    sprayed = SPRAYED.predict(CORE | {"hxt_water_spray": 0.4}, INPUTS)["hot_out_k"]
    assert sprayed == pytest.approx(290.0 - 0.4 * room_k + (110.0 + 0.4 * room_k) * LEFT)
    assert effectiveness(400.0, 345.0, 290.0) == 0.5


def test_ram_flux_is_static_density_times_airspeed():
    static_k = 293.15 / (1.0 + 0.2 * 0.24**2)
    density = 94e3 / (1.0 + 0.2 * 0.24**2) ** 3.5 / (287.05287 * static_k)
    airspeed_m_s = 0.24 * np.sqrt(1.4 * 287.05287 * static_k)
    assert ram_flux_kg_s_m2(0.24, 94e3, 293.15) == pytest.approx(density * airspeed_m_s, rel=1e-6)
