"""Numba where it is installed, plain Python where it is not."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import TypeVar, cast

F = TypeVar("F", bound=Callable[..., object])

try:
    from numba import njit

    COMPILED = True
except ImportError:  # numba accelerates; nothing depends on it
    COMPILED = False


def compiled(function: F) -> F:
    """Compile on the first call and keep the machine code on disk; leave the function as it is without numba.

    Of fast arithmetic only the fused multiply-add is allowed, which rounds once where the formula rounds twice. Code
    kept on disk is renewed when the function's own file changes, not when a file it calls into does: save both.
    """
    return cast("F", njit(cache=True, fastmath={"contract"})(function)) if COMPILED else function


def linked(function: F, **callees: object) -> F:
    """Copy a function with other callees: compiled code can call only compiled code."""
    return cast("F", FunctionType(function.__code__, function.__globals__ | callees, function.__name__))
