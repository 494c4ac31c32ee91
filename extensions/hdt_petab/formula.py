"""Equations of a declared model as text, traced by one call with symbols in place of arrays."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from hdt_core.physics.model import as_tuple

WORDS: Mapping[str, str] = {
    "add": "({} + {})",
    "subtract": "({} - {})",
    "multiply": "({} * {})",
    "divide": "({} / {})",
    "power": "({}^{})",
    "negative": "(-{})",
    "positive": "{}",
    "square": "({}^2)",
    "reciprocal": "(1 / {})",
    "sqrt": "sqrt({})",
    "exp": "exp({})",
    "log": "ln({})",
    "sin": "sin({})",
    "cos": "cos({})",
    "tan": "tan({})",
    "arctan": "arctan({})",
    "sinh": "sinh({})",
    "cosh": "cosh({})",
    "tanh": "tanh({})",
    "absolute": "abs({})",
    "minimum": "min({}, {})",
    "maximum": "max({}, {})",
    "less": "({} < {})",
    "less_equal": "({} <= {})",
    "greater": "({} > {})",
    "greater_equal": "({} >= {})",
}


class Formula(np.lib.mixins.NDArrayOperatorsMixin):
    """Symbolic quantity; arithmetic and NumPy functions on it build formulas.

    Examples
    --------
    >>> x = Formula("x")
    >>> str(2.0 * np.exp(-x) + 1.0)
    '((2.0 * exp((-x))) + 1.0)'
    """

    def __init__(self, text: str) -> None:
        self.text = text

    def __str__(self) -> str:
        return self.text

    def __bool__(self) -> bool:
        raise TypeError("the equations branch on a value, which no formula can")

    def __array_ufunc__(self, function: np.ufunc, method: str, *inputs: Any, **more: Any) -> "Formula":
        """Append a NumPy function to the formula.

        Raises
        ------
        TypeError
            It has no word in PEtab's mathematics.
        """
        if method != "__call__" or function.__name__ not in WORDS or more:
            raise TypeError(f"the equations use {function.__name__}, which cannot be written as a formula")
        return Formula(WORDS[function.__name__].format(*map(_text, inputs)))

    def __array_function__(self, function: Callable[..., Any], _types: Any, arguments: Any, _more: Any) -> "Formula":
        """Append `np.where`, the only supported branch.

        Raises
        ------
        TypeError
            It is another function.
        """
        if function is not np.where or len(arguments) != 3:
            raise TypeError(f"the equations use {function.__name__}, which cannot be written as a formula")
        condition, yes, no = map(_text, arguments)
        return Formula(f"piecewise({yes}, {condition}, {no})")


def formulas(function: Callable[..., Any], names: Sequence[str], fixed: Mapping[str, float]) -> tuple[str, ...]:
    """Return formulas of a function's results in `names`, with the values of `fixed` inserted.

    Raises
    ------
    TypeError
        The equations do what no formula can say: a branch on a value, a loop until something, a foreign function.
    """
    values: dict[str, Any] = {name: Formula(name) for name in names} | dict(fixed)
    return tuple(_text(value) for value in as_tuple(function(**values)))


def _text(value: Any) -> str:
    return value.text if isinstance(value, Formula) else repr(float(value))
