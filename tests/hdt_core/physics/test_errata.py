"""The tables of docs/errata.md are what the models say."""

import re
from pathlib import Path

import numpy as np
import pytest

from hdt_core.physics.compressor import expected_diameter_m
from hdt_core.physics.heat_exchanger import outlets_k
from hdt_core.physics.lumped_exchanger import tied_coefficient_w_k

ERRATA = (Path(__file__).parents[3] / "docs" / "errata.md").read_text(encoding="utf-8")


def rows(heading: str) -> list[list[float]]:
    """Numbers of the table whose header begins like this."""
    table = ERRATA[ERRATA.index(f"| {heading}") :].split("\n\n")[0].splitlines()[2:]
    cells = [line.replace(",", "").strip("| ").split("|") for line in table]
    return [[float(re.findall(r"-?\d+\.?\d*", cell)[-1]) for cell in row] for row in cells]


@pytest.mark.parametrize("row", rows("ram flow, kg/s"), ids=lambda r: f"ram {r[0]}")
def test_tied_h_of_a_cross_flow_exchanger(row):
    ram, *printed, last_ua = row
    at = {"hot_flow_kg_s": 0.9, "ram_flow_kg_s": ram, "hot_in_k": 390.0, "cold_in_k": 250.0}

    def h(ua):
        return tied_coefficient_w_k(**at, hot_out_k=outlets_k(0.9, ram, 390.0, 250.0, ua)[0])

    np.testing.assert_allclose([h(ua) for ua in (800.0, 1200.0, 1600.0)], printed, rtol=1e-3)
    assert h(last_ua - 1.0) > 0.0 > h(last_ua + 1.0)


@pytest.mark.parametrize("row", rows("range of VDA"), ids=lambda r: f"to {r[0]:.0f}")
def test_diameter_and_fit_of_equation_6(row):
    """The range is printed 0-N, so its number reads as -N."""
    top, diameter, r_squared = abs(row[0]), row[1], row[2]
    assert expected_diameter_m(top, 0.1731, -2.9304e-5) == pytest.approx(diameter, abs=5e-5)
    explained, left = (2.9304e-5 * top) ** 2 / 12.0, 0.0055**2 * np.pi / 2.0
    assert explained / (explained + left) == pytest.approx(r_squared, abs=5e-3)
