"""Estimate parameters that many units share, beside those of each unit and a level of each of its flights.

Rows are those of many units in order of time. The design is shared by all; every unit has parameters of its own with a
prior, such as the biases of its sensors; the level of a unit walks at random, so that what drifts isn't taken for
design. Where a controller answers to the level, the rows' derivatives depend on it and plain least squares is biased:
the derivatives are then regressed on instruments, which move them and don't depend on the level.

References
----------
.. [1] J. M. Wooldridge, Econometric Analysis of Cross Section and Panel Data, 2nd ed., 2010, chapters 5 and 11.
.. [2] P. W. Holland and R. E. Welsch, Robust regression using iteratively reweighted least-squares, Communications in
   Statistics A6(9), 1977.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from hdt_core.estimation.conclude import rests_on_bound
from hdt_core.estimation.estimate import Estimate, Status
from hdt_core.estimation.fit import Identifiability, covariance_of_free
from hdt_core.estimation.problem import Array, Belief, Integers
from hdt_core.robust import group_means

MAX_STEP = 0.5  # of a parameter of the order of one, in one iteration
Residual = Callable[[Array, Array], Array]
"""Of the design (p,) and the parameters of each row's unit (q, n): (n,), NaN where a row is unusable."""


@dataclass(frozen=True, slots=True)
class Equation:
    """Residual of every row, with the error `sd` of the equation itself; of neighbouring rows, which are not
    independent, `design_effect` count as one."""

    residual: Residual
    sd: float
    design_effect: float = 1.0


@dataclass(frozen=True, slots=True)
class Walk:
    """Level of a unit: a random walk of `step_sd` a unit of time that begins within `first_sd` of 0; each time scatters
    about it by `time_sd`."""

    step_sd: float
    time_sd: float
    first_sd: float


@dataclass(frozen=True, slots=True)
class Panel:
    """Rows (n,) of units, sorted by unit and time, with p parameters that all share, the design, and q of each unit."""

    names: tuple[str, ...]  # of the design
    bounds: Array  # (p, 2)
    prior: Belief  # of the design; its mean is the start
    unit_mean: Array  # (units, q), prior of each unit's parameters, which a unit without rows keeps
    unit_sd: Array  # (units, q)
    unit: Integers  # (n,)
    time: Integers  # (n,)
    levelled: Equation  # its residual is the unit's level at that time
    walk: Walk
    noise_sd: Array  # (n, q), noise of a row in the quantities that the unit's parameters shift
    step: Array  # (p,), of derivatives by differences
    unit_step: Array  # (q,)
    others: tuple[Equation, ...] = ()  # of residuals without a level
    instruments: Array | None = None  # (n, k); without them the derivatives count as they are
    prior_terms: Callable[[Array], Array] = lambda design: design[:0]  # residuals of the design alone, of sd 1


class PanelFit(NamedTuple):
    """End of an estimation: also the level of each row and the weight of each row in each equation, (n,).

    A weight is over the residual's variance, less where the row is an outlier, 0 where it is unusable.
    """

    estimate: Estimate
    units: Array  # (units, q)
    level: Array
    weights: tuple[Array, ...]


class _Levels(NamedTuple):
    """Level of each row, unit of each of m levels, time since the unit's level before, infinite for its first."""

    of_row: Integers
    unit: Integers
    gap: Array


@dataclass(frozen=True, slots=True)
class PanelLeastSquares:
    """Gauss-Newton on design, units and levels together, with Cauchy's weights; a level that jumps is freed.

    Eliminating the levels costs a tridiagonal solve, eliminating a unit's parameters one of q x q: the work is linear
    in rows.
    """

    name: str = "panel"
    max_steps: int = 30
    min_steps: int = 7
    tolerance: float = 1e-4  # step of a parameter below which it has settled
    max_step: float = MAX_STEP
    cauchy_sd: float = 3.0  # standard deviations at which a row's weight is halved
    jump_sd: float = 4.0  # steps of the walk beyond which a level jumps
    jump_freedom: float = 1e3  # by which the walk's variance is raised there
    steps_before_jumps: int = 3

    def estimate(self, panel: Panel) -> tuple[Estimate, Array]:
        """Estimate the design, and the parameters of each unit, (units, q).

        The status is `converged`, `at_bound`, `max_steps` or `not_identifiable`; identifiability is that of the rows
        alone, the units' parameters within their priors.
        """
        estimate, units, _ = self._descend(panel)
        return estimate, units

    def fit(self, panel: Panel) -> PanelFit:
        """Estimate the panel and return also what another method needs to estimate the design given the rest."""
        estimate, units, level = self._descend(panel)
        nothing = np.zeros(len(panel.unit))
        of_row = nothing if level is None else level[_index_levels(panel).of_row]
        pairs = ((panel.levelled, of_row), *((equation, nothing) for equation in panel.others))
        weights = (self._linearise(panel, e, estimate.belief.mean, units, expected)[1] for e, expected in pairs)
        return PanelFit(estimate, units, of_row, tuple(weights))

    def _descend(self, panel: Panel) -> tuple[Estimate, Array, Array | None]:
        """Return the estimate, the units' parameters and the levels, none without rows."""
        design = panel.prior.mean
        units = panel.unit_mean
        level = None
        n_steps = 0
        status: Status = "max_steps"
        data = Identifiability(panel.names, np.zeros_like(panel.prior.cov))
        if not len(panel.unit):
            return Estimate(panel.prior, "converged", 0, data, method=self.name), units, None
        levels = _index_levels(panel)
        gap = levels.gap
        while n_steps < self.max_steps and (status == "max_steps" or n_steps < self.min_steps):
            normal, of_unit, of_level = self._eliminate(panel, levels._replace(gap=gap), design, units, level)
            target, cov, is_finite = self._solve(panel, design, normal)
            step = target - design
            design = target
            n_steps = n_steps + 1
            change = of_unit @ np.r_[-step, 1.0]
            units = units + change
            moves = np.column_stack([np.tile(step, (len(of_level), 1)), change[levels.unit], np.ones(len(of_level))])
            level = (of_level * moves).sum(axis=1)
            if n_steps > self.steps_before_jumps:
                is_jump = np.abs(np.diff(level)) > self.jump_sd * panel.walk.step_sd
                gap = levels.gap * (1.0 + self.jump_freedom * is_jump)
            status = "converged" if np.abs(step).max() < self.tolerance else "max_steps"
            data = Identifiability(panel.names, normal[:, :-1])
        if not is_finite or rests_on_bound(panel.bounds, design, cov):
            status = "at_bound" if is_finite else "not_identifiable"
        n_evals = n_steps * (1 + design.size + units.shape[1])
        return Estimate(Belief(design, cov), status, n_evals, data, method=self.name), units, level

    def _solve(self, panel: Panel, design: Array, normal: Array) -> tuple[Array, Array, bool]:
        """Add the priors and solve for the next design, inside its bounds; return also its covariance, and whether that
        is finite."""
        prior = panel.prior
        terms = panel.prior_terms(design)
        slope = forward_differences(panel.prior_terms, design, terms, panel.step, panel.bounds[:, 1])
        information = normal[:, :-1] + prior.information + slope.T @ slope
        right = normal[:, -1] + prior.information @ (prior.mean - design) - slope.T @ terms
        low, high = panel.bounds.T
        is_held = ((design <= low) & (right < 0.0)) | ((design >= high) & (right > 0.0))
        free_cov = covariance_of_free(np.where(is_held[:, None], 0.0, panel.bounds), information)[0]
        step = np.clip(np.where(np.isfinite(free_cov), free_cov, 0.0) @ right, -self.max_step, self.max_step)
        return np.clip(design + step, low, high), *covariance_of_free(panel.bounds, information)

    def _eliminate(
        self, panel: Panel, levels: _Levels, design: Array, units: Array, level: Array | None
    ) -> tuple[Array, Array, Array]:
        """Linearise here, and eliminate levels and units.

        Return the normal equations of the design by the rows alone, (p, p + 1), and what gives units and levels back
        after a step of it, (units, q, p + 1) and (m, p + q + 1).
        """
        expected, nothing = (None, None) if level is None else (level[levels.of_row], np.zeros(len(panel.unit)))
        columns, weight = self._linearise(panel, panel.levelled, design, units, expected)
        gram, of_level = _eliminate_levels(panel, levels, columns, weight)
        for equation in panel.others:
            columns, weight = self._linearise(panel, equation, design, units, nothing)
            gram += _cross_by_unit(panel.unit, len(units), columns * weight[:, None], columns)
        p = design.size
        own = slice(design.size, -1)
        prior = panel.unit_sd[:, :, None] ** -2.0 * np.eye(units.shape[1])
        right = (panel.unit_mean - units) / panel.unit_sd**2 - gram[:, own, -1]
        of_unit = np.linalg.solve(gram[:, own, own] + prior, np.concatenate([gram[:, own, :p], right[..., None]], 2))
        total = np.concatenate([gram[:, :p, :p], -gram[:, :p, -1:]], axis=2) - gram[:, :p, own] @ of_unit
        return total.sum(axis=0), of_unit, of_level

    def _linearise(
        self, panel: Panel, equation: Equation, design: Array, units: Array, expected: Array | None
    ) -> tuple[Array, Array]:
        """Compute derivatives by design and unit and the residual, (n, p + q + 1), and weights (n,), 0 where unusable.

        Noise is propagated through the equation; Cauchy's weights are about the `expected` residual.
        """
        of_row = units[panel.unit].T
        function = equation.residual
        residual = function(design, of_row)
        origin = np.zeros(units.shape[1])
        by_design = forward_differences(lambda d: function(d, of_row), design, residual, panel.step, panel.bounds[:, 1])
        by_unit = forward_differences(
            lambda shift: function(design, of_row + shift[:, None]), origin, residual, panel.unit_step
        )
        columns = np.column_stack([by_design, by_unit, residual])
        usable = np.asarray(np.isfinite(columns).all(axis=1))
        columns = np.where(usable[:, None], columns, 0.0)
        noise = ((columns[:, design.size : -1] * panel.noise_sd) ** 2).sum(axis=1)
        weight = np.where(usable, 1.0 / (noise + equation.sd**2), 0.0)
        square = 0.0 if expected is None else (columns[:, -1] - expected) ** 2 * weight
        return columns, weight / (1.0 + square / self.cauchy_sd**2) / equation.design_effect


def forward_differences(
    function: Callable[[Array], Array], x: Array, value: Array, step: Array, upper: Array | float = np.inf
) -> Array:
    """Compute the derivatives of `function`, which has this `value` (n,) at `x` (p,): (n, p). Backwards where the step
    would pass `upper`."""
    moves = np.diag(np.where(x + step <= upper, step, -step))
    return np.reshape([(function(x + move) - value) / move.sum() for move in moves], (x.size, value.size)).T


def _index_levels(panel: Panel) -> _Levels:
    starts = np.r_[True, (np.diff(panel.unit) != 0) | (np.diff(panel.time) != 0)]
    unit = panel.unit[starts]
    time = panel.time[starts]
    return _Levels(np.cumsum(starts) - 1, unit, np.where(np.diff(unit) != 0, np.inf, np.diff(time)))


def _cross_by_unit(unit: Integers, n_units: int, left: Array, right: Array) -> Array:
    """Compute the cross products of columns over the rows of each unit. (units, a, b)"""
    ends = np.searchsorted(unit, np.arange(n_units + 1))
    return np.stack([left[a:b].T @ right[a:b] for a, b in pairwise(ends)])


def _eliminate_levels(panel: Panel, levels: _Levels, columns: Array, weight: Array) -> tuple[Array, Array]:
    """Compute cross products of each unit's columns with the levels eliminated, (units, p + q + 1, p + q + 1), and what
    the walk leaves of each column, (m, p + q + 1).

    Rows of a level are compared as they are, levels through the instruments: two-stage least squares.
    """
    n = len(panel.unit_mean)
    k = columns.shape[1]
    every = columns if panel.instruments is None else np.column_stack([columns, panel.instruments])
    means, total = group_means(every, levels.of_row, weight)
    level_weight = 1.0 / (1.0 / total + panel.walk.time_sd**2 * panel.levelled.design_effect)
    smoothed = _smooth(panel, levels, level_weight, means)
    innovation = (means - smoothed) * level_weight[:, None]
    predictor = means[:, : k - 1]
    pull = innovation[:, : k - 1]
    if panel.instruments is not None:
        z = means[:, k:]
        z_innovation = innovation[:, k:]
        first_stage = np.linalg.solve(z.T @ z_innovation + 1e-9 * np.eye(z.shape[1]), z_innovation.T @ predictor)
        predictor = z @ first_stage
        pull = z_innovation @ first_stage
    deviation = columns - means[levels.of_row, :k]
    gram = _cross_by_unit(panel.unit, n, deviation * weight[:, None], deviation)
    gram[:, :-1] += _cross_by_unit(levels.unit, n, pull, np.column_stack([predictor, means[:, k - 1]]))
    return gram, smoothed[:, :k]


def _smooth(panel: Panel, levels: _Levels, weight: Array, values: Array) -> Array:
    """Smooth values (m, columns) by the random walk of each unit: a tridiagonal solve."""
    stiffness = 1.0 / (panel.walk.step_sd**2 * panel.levelled.design_effect * levels.gap)
    band = np.zeros((2, len(weight)))
    band[1] = weight + np.r_[True, levels.gap == np.inf] / panel.walk.first_sd**2
    band[1, :-1] += stiffness
    band[1, 1:] += stiffness
    band[0, 1:] = -stiffness
    if len(weight) == 1:  # LAPACK's tridiagonal solver wants two
        return np.asarray(weight[:, None] * values / band[1])
    return np.asarray(solveh_banded(band, weight[:, None] * values))
