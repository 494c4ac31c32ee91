"""Numba where it is installed, plain Python where it is not."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from importlib.util import find_spec
from types import FunctionType
from typing import Any, TypeVar, cast

F = TypeVar("F", bound=Callable[..., object])

COMPILED = find_spec("numba") is not None
"""Numba accelerates; nothing depends on it."""


def compiled(function: F) -> F:
    """Compile on the first call and keep the machine code on disk; leave the function as it is without numba.

    Of fast arithmetic only the fused multiply-add is allowed, which rounds once where the formula rounds twice. Code
    kept on disk is renewed when the function's own file changes, not when a file it calls into does: save both.
    """
    return cast("F", _Compiled(function)) if COMPILED else function


class _Compiled:
    """A function and, from its first call on, its machine code: Numba loads for a quarter of a second."""

    def __init__(self, function: Callable[..., object]) -> None:
        self.py_func = function

    def __call__(self, *args: object) -> object:
        return self.machine_code(*args)

    @cached_property
    def machine_code(self) -> Any:
        from numba import njit  # noqa: PLC0415 (see above)

        names, space = self.py_func.__code__.co_names, self.py_func.__globals__
        callees = {n: space[n].machine_code for n in names if isinstance(space.get(n), _Compiled)}
        return njit(cache=True, fastmath={"contract"})(linked(self.py_func, **callees))


def linked(function: F, **callees: object) -> F:
    """Copy a function with other callees: compiled code can call only compiled code."""
    return cast("F", FunctionType(function.__code__, function.__globals__ | callees, function.__name__))
