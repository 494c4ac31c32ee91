"""A declared model's rates over columns of states and arguments: in NumPy, and compiled where numba can."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from functools import lru_cache
from types import FunctionType
from typing import Any

from hdt_core.estimation.problem import Array
from hdt_core.estimation.trajectory import ColumnRates, column_signature
from hdt_core.physics.model import Equation, as_tuple


def column_rates(
    rates: Equation, state_names: tuple[str, ...], argument_names: tuple[str, ...], *, compiled: bool
) -> ColumnRates:
    """Return `rates` as a function of columns; `compiled` where numba takes its source."""
    quick = _compile(rates, state_names, argument_names) if compiled and isinstance(rates, FunctionType) else None
    return _in_numpy(rates, state_names, argument_names) if quick is None else quick


def _in_numpy(rates: Equation, state_names: Sequence[str], argument_names: Sequence[str]) -> ColumnRates:
    names = (*state_names, *argument_names)

    def columns(x: Array, arguments: Array, out: Array) -> None:
        values = dict(zip(names, (*x, *arguments), strict=True))
        for j, rate in enumerate(as_tuple(rates(**values))):
            out[j] = rate

    return columns


@lru_cache(64)
def _compile(rates: FunctionType, state_names: tuple[str, ...], argument_names: tuple[str, ...]) -> ColumnRates | None:
    """Compile a loop over the columns; None where the source is not plain arithmetic of its arguments."""
    from numba import njit  # noqa: PLC0415 (loads for half a second)
    from numba.core.errors import NumbaError  # noqa: PLC0415

    parameters = inspect.signature(rates).parameters
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return None
    place = {name: f"x[{j}, p]" for j, name in enumerate(state_names)}
    place |= {name: f"arguments[{j}, p]" for j, name in enumerate(argument_names)}
    called = ", ".join(place[name] for name in parameters)
    written = ", ".join(f"out[{j}, p]" for j in range(len(state_names)))
    source = f"def columns(x, arguments, out):\n    for p in range(x.shape[1]):\n        {written} = rates({called})\n"
    space: dict[str, Any] = {"rates": njit(_with_positions(rates), error_model="numpy")}
    exec(source, space)
    try:
        return njit(column_signature(), error_model="numpy")(space["columns"])  # type: ignore[no-any-return]
    except NumbaError:
        return None


def _with_positions(function: FunctionType) -> FunctionType:
    """Copy a function with arguments by position, which numba needs."""
    code = function.__code__
    n_arguments = code.co_argcount + code.co_kwonlyargcount
    by_position = code.replace(co_argcount=n_arguments, co_kwonlyargcount=0)
    return FunctionType(by_position, function.__globals__, function.__name__, None, function.__closure__)
