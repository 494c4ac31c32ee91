"""Numba where it is installed, plain Python where it is not; and what a problem may bring compiled."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import TypeVar, cast

from hdt_core.estimation.problem import Array

F = TypeVar("F", bound=Callable[..., object])

try:
    from numba import njit

    COMPILED = True
except ImportError:  # numba accelerates; nothing depends on it
    COMPILED = False


def compiled(function: F) -> F:
    """Compile on the first call and keep the machine code on disk; leave the function as it is without numba.

    Of fast arithmetic only the fused multiply-add is let in: it rounds once where the formula rounds twice. Code kept
    on disk is renewed when the function's own file changes, not when a file it calls into does: save both.
    """
    return cast("F", njit(cache=True, fastmath={"contract"})(function)) if COMPILED else function


def linked(function: F, **callees: object) -> F:
    """The same function calling these in the place of its own callees: compiled code can call only compiled code."""
    return cast("F", FunctionType(function.__code__, function.__globals__ | callees, function.__name__))


@dataclass(frozen=True, slots=True)
class Kernels:
    """Compiled equivalents of a problem's functions, bound to its record. The answers must equal those without.

    Parameters
    ----------
    simulate : thetas (p, n) -> outputs (p, k, m)
    chi2 : thetas (p, n) -> weighted sums of squares (p,)
    sensitivity : theta (n,) -> d outputs / d theta (k, m, n), optional
    least_squares : (origin, lower, upper, prior mean, prior information, steps) ->
        (theta, objective, half its gradient, J^T J with the prior, n_evals, settled): a `Point`, optional
    kalman : (prior mean, prior cov, unknown?, lower, upper, sigma points?, smoother passes, deviations at rest) ->
        (path (k, n), path sd (k, n), mean (n,), cov (n, n), passes made), optional
    """

    simulate: Callable[[Array], Array]
    chi2: Callable[[Array], Array]
    sensitivity: Callable[[Array], Array] | None = None
    least_squares: Callable[..., tuple[Array, float, Array, Array, int, bool]] | None = None
    kalman: Callable[..., tuple[Array, Array, Array, Array, int]] | None = None
