"""Estimation problems whose answers are linear algebra or a closed form: a straight line, and one parameter."""

from collections.abc import Callable
from typing import Any

import numpy as np

from hdt_core.estimation import Problem, unknown

X = np.linspace(-1.0, 2.0, 12)
SLOPES = np.column_stack([np.ones(12), X]) / 0.1
"""Of the line's residuals, in deviations."""


def line_through(measured: np.ndarray, **more: Any) -> Problem:
    """Offset and slope of twelve values at `X`, each known to 0.1."""
    fields = {"names": ("offset", "slope"), "bounds": np.tile([-50.0, 50.0], (2, 1)), "prior": unknown(np.zeros(2)),
             "measured": measured[:, None], "sigma": np.array([0.1]),
             "observe": lambda _x, theta, i: (theta[0] + theta[1] * X[i])[None]}  # fmt: skip
    return Problem(**(fields | more))


def scalar_problem(
    response: Callable[[Any], Any] = lambda x: x,
    measured: Any = 0.0,
    *,
    bounds: tuple[float, float] = (-np.inf, np.inf),
    start: float = 0.0,
    sigma: float = 1.0,
    **more: Any,
) -> Problem:
    """One parameter, measured as its response."""
    fields = {"names": ("x",), "bounds": np.array([bounds]), "prior": unknown(np.array([start])),
             "measured": np.atleast_1d(measured)[:, None], "sigma": np.array([sigma]),
             "observe": lambda _x, theta, i: (response(theta[0]) + 0.0 * i)[None]}  # fmt: skip
    return Problem(**(fields | more))
