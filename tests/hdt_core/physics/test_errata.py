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


RESIMULATED = re.findall(
    r"\| (UKF|EKF|PSO|NLS) \| ([\d.]+), ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", ERRATA
)


def positions_m(damping, stiffness):
    """Section 3.2.2 by the book: Euler's rule from rest, 1,001 samples at 0.01 s, 1 kg, sin(pi t) N."""
    x, v, positions = 0.0, 0.0, []
    for k in range(1001):
        positions.append(x)
        x, v = x + 0.01 * v, v + 0.01 * (np.sin(np.pi * 0.01 * k) - damping * v - stiffness * x)
    return np.array(positions)


@pytest.mark.parametrize("row", RESIMULATED, ids=lambda row: row[0])
def test_table_2_is_not_computed_from_table_1(row):
    """What the page gives for the printed parameters is what they simulate, and not what table 2 prints."""
    damping, stiffness, printed_mse, mse, printed_mape, mape = map(float, row[1:])
    truth = positions_m(0.5, 2.0)
    off = np.abs(positions_m(damping, stiffness) - truth)
    assert np.mean(off**2) == pytest.approx(mse, rel=5e-3, abs=1e-12)
    assert np.mean(off[truth != 0.0] / np.abs(truth[truth != 0.0])) == pytest.approx(mape, rel=5e-3, abs=1e-9)
    rounded = [positions_m(damping + c, stiffness + k) for c in (-5e-4, 5e-4) for k in (-5e-4, 5e-4)]
    assert max(np.mean((x - truth) ** 2) for x in rounded) < 0.75 * printed_mse
    assert abs(mape - printed_mape) > 0.1 * printed_mape


def test_all_four_columns_of_the_table_are_there():
    assert [row[0] for row in RESIMULATED] == ["UKF", "EKF", "PSO", "NLS"]
