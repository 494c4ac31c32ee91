"""Many estimation problems of one model, side by side in one record."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

import numpy as np

from hdt_core.estimation.problem import Array, Integers, Problem, Sample


@dataclass(frozen=True)
class Batch(Problem):
    """Estimation problems of one model without states, whose samples follow one another in one record.

    Parameters are arrays (b, n), of p simulations (p, b, n), and what is one number for a problem is an array (b,).

    Parameters
    ----------
    group : array (k,) of int
        Number of the problem that each sample is of; numbers count from 0 without gaps and ascend.
    """

    group: Integers = field(kw_only=True)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.transition is not None or self.group.shape != (len(self.measured),):
            raise ValueError("a batch is of models without states, and every sample names its problem")

    @classmethod
    def of(cls, problem: Problem, group: Integers) -> Batch:
        """Split a problem's samples into problems of their own, by number (k,)."""
        return cls(**_fields(problem), group=group)

    @cached_property
    def first(self) -> Integers:
        """First row of every problem. (b,)"""
        return np.searchsorted(self.group, np.arange(self.group[-1] + 1 if len(self.group) else 0))

    @property
    def n_problems(self) -> int:
        """Number of problems."""
        return len(self.first)

    def sum_each(self, values: Array) -> Array:
        """Sum values of every sample over those of each problem: (k, ...) to (b, ...)."""
        return np.asarray(np.add.reduceat(values, self.first))

    def select(self, problems: Integers) -> Problem:
        """Return the batch of these problems (numbers, ascending) alone."""
        if len(problems) == self.n_problems:
            return self
        is_among = np.zeros(self.n_problems, bool)
        is_among[problems] = True
        rows = np.flatnonzero(is_among[self.group])
        return Batch.of(self._of_rows(rows), (np.cumsum(is_among) - 1)[self.group[rows]])

    def single(self, number: int) -> Problem:
        """Return one problem by itself."""
        return self._of_rows(np.arange(*np.searchsorted(self.group, [number, number + 1])))

    def objective_each(self, thetas: Array) -> Array:
        """Compute the objective of each problem: (p, b, n) to (p, b)."""
        return self.objective(thetas)

    def linearised_each(self, theta: Array) -> tuple[Array, Array]:
        """Compute `residual` and `sensitivity` at `theta` (b, n)."""
        return self.linearised(theta)

    def _of_rows(self, rows: Integers) -> Problem:
        """Return the problem of some samples, all of one set of parameters."""

        def observe(x: Array, theta: Array, i: Sample) -> Array:
            return self.observe(x, theta, rows[i])

        return Problem(**(_fields(self) | {"measured": self.measured[rows], "observe": observe}))

    @property
    def _n_axes(self) -> int:
        return 2

    def _of_samples(self, values: Array) -> Array:
        return np.moveaxis(values[:, self.group], -1, 0)

    def _sum_of_squares(self, residual: Array) -> Array:
        squares = np.einsum("pkm,pkm->pk", residual, residual)
        return np.asarray(np.add.reduceat(squares, self.first, axis=1))


def _fields(problem: Problem) -> dict[str, Any]:
    return {f.name: getattr(problem, f.name) for f in fields(Problem)}
