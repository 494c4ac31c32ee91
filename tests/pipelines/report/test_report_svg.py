"""Axes and marks."""

import math
from datetime import UTC, datetime
from itertools import pairwise

from hypothesis import example, given
from hypothesis import strategies as st

from pipelines.report import svg

numbers = st.floats(-1e6, 1e6, allow_nan=False)


@given(numbers, st.floats(1e-6, 1e6))
@example(879_610.0, 1e-6)  # a float there is known to 1e-10
@example(-944_415.9907521999, 1e-6)
@example(-115_257.0, 1e-6)
def test_ticks_are_few_even_and_inside(low, width):
    marks = svg.ticks(low, low + width)
    assert 1 <= len(marks) <= 7
    assert all(low <= m <= low + width for m in marks)
    steps = [b - a for a, b in pairwise(marks)]
    known_to = math.ulp(max(abs(low), abs(low + width)))
    assert max(steps, default=0) - min(steps, default=0) <= 8 * known_to + 1e-8 * width


@given(st.integers(0, 2_000_000_000), st.integers(3600, 400_000_000))
def test_months_are_few_inside_and_in_order(low, width):
    marks = svg.month_ticks(low, low + width)
    assert len(marks) <= 14
    assert all(low <= t <= low + width for t, _ in marks)
    assert [t for t, _ in marks] == sorted(t for t, _ in marks)


def test_a_year_is_marked_by_months():
    low, high = (datetime(2024, m, 15, tzinfo=UTC).timestamp() for m in (2, 7))
    assert [name for _, name in svg.month_ticks(low, high)] == ["Mar", "Apr", "May", "Jun", "Jul"]


@given(numbers, numbers, numbers, numbers)
def test_a_point_never_leaves_the_picture(a, b, x, y):
    chart = svg.Chart((min(a, b), max(a, b)), (min(a, b), max(a, b)), "any")
    px, py = chart.at(x, y)
    assert 0 <= px <= chart.width
    assert 0 <= py <= chart.height


def test_up_is_up_and_right_is_right():
    chart = svg.Chart((0, 10), (0, 1), "any")
    (x0, y0), (x1, y1) = chart.at(1, 0.2), chart.at(9, 0.8)
    assert x1 > x0
    assert y1 < y0
