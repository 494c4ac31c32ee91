"""Curves kept at a few points: read between them by straight lines, beyond them by the last."""

import numpy as np
import pytest

from hdt_core.margin.curves import falls_through, read_across
from hdt_core.margin.margin import at_excess


@pytest.mark.parametrize(("value", "at"), [(3.0, 0.5), (1.5, 2.0), (2.0, 1.0), (5.0, -0.5), (0.5, 4.0)])
def test_a_falling_curve_comes_down_to_a_value_between_two_points_or_beyond_them(value, at):
    # 4 at 0, 2 at 1, 1 at 3
    assert falls_through(np.array([[4.0, 2.0, 1.0]]), np.array([0.0, 1.0, 3.0]), value)[0] == pytest.approx(at)


@pytest.mark.parametrize(
    ("at", "value", "slope"),
    [(0.5, 15.0, 10.0), (2.0, 40.0, 20.0), (1.0, 20.0, 10.0), (-1.0, 0.0, 10.0), (5.0, 100.0, 20.0)],
)
def test_values_over_a_rising_grid(at, value, slope):
    # 10 at 0, 20 at 1, 60 at 3
    read = read_across(np.array([[0.0, 1.0, 3.0]]), np.array([10.0, 20.0, 60.0]), np.array([at]))
    assert [float(r[0]) for r in read] == pytest.approx([value, slope])


@pytest.mark.parametrize(
    ("excess_k", "value"), [(-25.0, -0.5), (-15.0, 0.5), (0.0, 4.0), (3.0, 7.0), (7.0, 11.8), (12.0, 18.8)]
)
def test_a_curve_over_the_excesses(excess_k, value):
    # 0, 1, 4, 9, 16 at -20, -10, 0, 5, 10 K
    assert at_excess(np.array([[0.0, 1.0, 4.0, 9.0, 16.0]]), excess_k)[0] == pytest.approx(value)
