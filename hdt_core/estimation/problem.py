"""Estimation problem: prior, measurements and model, independent of the method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import ndtri

Array = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Sample = int | Integers
Observe = Callable[[Array, Array, Sample], Array]
Transition = Callable[[Array, Array, Sample], Array]
Trajectory = Callable[[Array, int], Array]


@dataclass(frozen=True)
class Belief:
    """Gaussian distribution of n quantities.

    Parameters
    ----------
    mean : array (n,)
        Expected values, each in the unit of its quantity.
    cov : array (n, n)
        Covariance. An infinite variance on the diagonal (with zeros beside it) stands for no knowledge at all.
    """

    mean: Array
    cov: Array

    @cached_property
    def sd(self) -> Array:
        """Standard deviations, (n,)."""
        return np.sqrt(np.maximum(self.cov.diagonal(), 0.0))

    @cached_property
    def information(self) -> Array:
        """Inverse covariance, (n, n); zero in the rows of an infinite variance."""
        variance = np.diag(self.cov)
        if np.count_nonzero(self.cov) == np.count_nonzero(variance):
            return np.diag(1.0 / variance)
        is_known = np.isfinite(variance)
        info = np.zeros_like(self.cov)
        info[np.ix_(is_known, is_known)] = np.linalg.pinv(self.cov[np.ix_(is_known, is_known)], hermitian=True)
        return info

    def interval(self, level: float = 0.9) -> Array:
        """Compute the central interval of every quantity at a probability `level` [0..1], (n, 2)."""
        half = ndtri(0.5 + 0.5 * level) * self.sd
        return np.column_stack([self.mean - half, self.mean + half])


def unknown(mean: Array) -> Belief:
    """Build a start at `mean` (n,) with infinite variance."""
    return Belief(np.asarray(mean, float), np.diag(np.full(len(mean), np.inf)))


@dataclass(frozen=True, slots=True)
class Kernels:
    """Compiled equivalents of a problem's functions, bound to its record. Results must equal those without.

    Parameters
    ----------
    simulate : thetas (p, n) -> outputs (p, k, m)
    chi2 : thetas (p, n) -> weighted sums of squares (p,)
    sensitivity : theta (n,) -> d outputs / d theta (k, m, n), optional
    least_squares : (origin, lower, upper, prior mean, prior information, steps) ->
        (theta, objective, half its gradient, J^T J with the prior, n_evals): a `Point`, optional
    kalman : (prior mean, prior cov, unknown?, lower, upper, sigma points?, smoother passes, deviations at rest) ->
        (path (k, n), path sd (k, n), mean (n,), cov (n, n), passes made), optional
    """

    simulate: Callable[[Array], Array]
    chi2: Callable[[Array], Array]
    sensitivity: Callable[[Array], Array] | None = None
    least_squares: Callable[..., tuple[Array, float, Array, Array, int]] | None = None
    kalman: Callable[..., tuple[Array, Array, Array, Array, int]] | None = None


@dataclass(frozen=True)
class Problem:
    r"""Parameters, and hidden states where there are any, to be estimated from samples in order.

    .. math:: x_{i+1} = f(x_i, \theta_i, i) + w_i, \quad y_i = h(x_i, \theta_i, i) + v_i,
              \quad \theta_{i+1} = \theta_i + d_i

    The two functions broadcast: the first axis of `x` and `theta` is the component, the axes behind it broadcast with
    each other and with the sample index, which may be an integer or an array of integers. So one function serves a
    single trajectory, a swarm, a cloud of sigma points and a whole record.

    Parameters
    ----------
    names : tuple of str, n of them
    bounds : array (n, 2)
        Lower and upper limit of every parameter; infinite where there is none; equal where it is fixed.
    prior : Belief
        About the parameters before the samples. Its mean is the starting point of every method.
    measured : array (k, m)
        NaN where a value is missing.
    sigma : array (m,)
        Standard deviation of the noise of every output.
    observe : function (x, theta, i) -> (m, ...)
    transition : function (x, theta, i) -> (s, ...), optional
        State at sample i + 1 from that at i. None: no states, every sample stands alone.
    start : Belief, optional
        About the states at sample 0. Methods that fit the whole record at once take its mean as known.
    process_sd : array (s,), optional
        Standard deviation of w per sample; zero when not given.
    drift : array (n,), optional
        Standard deviation of d per sample, the parameters' random walk; zero when not given.
    half_steps : function like `transition`, optional
        The same in two half steps, for the error that the step leaves in an estimate.
    trajectory : function (theta (n, p), k) -> (k, s, p), optional
        The states at k samples from the mean start, as repeated transitions give them; quicker than these.
    kernels : Kernels, optional
        Compiled equivalents of the above.

    Notes
    -----
    Methods that estimate many problems side by side take `batch.Batch`, of which this is one of a single problem: what
    they are given and return by problem has a first axis of one.
    """

    names: tuple[str, ...]
    bounds: Array
    prior: Belief
    measured: Array
    sigma: Array
    observe: Observe
    transition: Transition | None = None
    start: Belief = field(default_factory=lambda: Belief(np.empty(0), np.empty((0, 0))))
    process_sd: Array | None = None
    drift: Array | None = None
    half_steps: Transition | None = None
    trajectory: Trajectory | None = None
    kernels: Kernels | None = None

    def __post_init__(self) -> None:
        n = len(self.names)
        if self.bounds.shape != (n, 2) or self.prior.mean.shape != (n,) or self.prior.cov.shape != (n, n):
            raise ValueError(f"{n} names, but bounds {self.bounds.shape} and a prior of {self.prior.mean.shape}")
        if self.measured.ndim != 2 or self.measured.shape[1:] != self.sigma.shape:
            raise ValueError(f"measured is {self.measured.shape}, sigma {self.sigma.shape}: want (k, m) and (m,)")
        if not (np.diag(self.prior.cov) > 0.0).all() or not (self.sigma > 0.0).all():
            raise ValueError("prior variances and sigma must be positive; hold a parameter by equal bounds")
        if not (self.bounds[:, 0] <= self.bounds[:, 1]).all():
            raise ValueError("a lower bound lies above its upper bound")

    @cached_property
    def origin(self) -> Array:
        """Start of every method: the prior's mean, moved inside the bounds. (n,)"""
        return np.clip(self.prior.mean, self.bounds[:, 0], self.bounds[:, 1])

    @property
    def search_box(self) -> tuple[Array, Array]:
        """Lower and upper corner (n,) of the box that global methods search.

        The bounds; where there are none, four standard deviations of the prior; without a prior, ten times the
        starting value or ten about zero.
        """
        sd, (lower, upper) = self.prior.sd, self.bounds.T
        reach = np.where(np.isfinite(sd), 4.0 * sd, 10.0 * np.maximum(np.abs(self.origin), 1.0))
        lower = np.where(np.isfinite(lower), lower, self.origin - reach)
        return lower, np.where(np.isfinite(upper), upper, self.origin + reach)

    @cached_property
    def n_values(self) -> int:
        """Number of measured values that are not missing."""
        return int(np.count_nonzero(~np.isnan(self.measured)))

    @property
    def n_problems(self) -> int:
        """Number of problems in the batch."""
        return 1

    def sum_each(self, values: Array) -> Array:
        """Sum values of every sample over those of each problem: (k, ...) to (b, ...)."""
        return np.asarray(values.sum(axis=0)[None])

    def select(self, problems: Integers) -> Problem:
        """Return the batch of these problems (numbers, ascending) alone."""
        return self

    def single(self, number: int) -> Problem:
        """Return one problem of the batch by itself."""
        return self

    def simulate(self, theta: Array) -> Array:
        """Simulate outputs without noise from the mean start: theta (n,) to (k, m), (p, n) to (p, k, m)."""
        thetas = theta[None] if np.ndim(theta) == self._n_axes else theta
        outputs = self._simulate(thetas) if self.kernels is None else self.kernels.simulate(thetas)
        return outputs if thetas is theta else outputs[0]

    def _simulate(self, thetas: Array) -> Array:
        n_samples, n_outputs = self.measured.shape
        if self.transition is None:
            nothing = np.empty((0, 1, 1))
            outputs = np.asarray(self.observe(nothing, self._of_samples(thetas), np.arange(n_samples)))
            return np.broadcast_to(outputs, (n_outputs, len(thetas), n_samples)).transpose(1, 2, 0)
        if self.trajectory is not None:
            states = np.moveaxis(self.trajectory(thetas.T, n_samples), 0, -1)
            outputs = np.asarray(self.observe(states, thetas.T[:, :, None], np.arange(n_samples)))
            return np.broadcast_to(outputs, (n_outputs, len(thetas), n_samples)).transpose(1, 2, 0)
        x = np.repeat(self.start.mean[:, None], len(thetas), axis=1)
        outputs = np.empty((len(thetas), n_samples, n_outputs))
        for i in range(n_samples):
            outputs[:, i] = np.asarray(self.observe(x, thetas.T, i)).T
            if i + 1 < n_samples:
                x = np.asarray(self.transition(x, thetas.T, i))
        return outputs

    def residual(self, theta: Array) -> Array:
        """Compute (simulated - measured) / sigma, 0 where missing, infinite where the model fails."""
        with np.errstate(all="ignore"):
            return self._residual(self.simulate(theta))

    def _residual(self, outputs: Array) -> Array:
        residual = (outputs - self.measured) / self.sigma
        return np.where(np.isnan(self.measured), 0.0, np.where(np.isfinite(residual), residual, np.inf))

    def chi2(self, thetas: Array) -> Array:
        """Compute the weighted sum of squares of every row of `thetas` (p, n): (p,). Infinite where the model fails."""
        if self.kernels is not None:
            return self.kernels.chi2(thetas)
        with np.errstate(all="ignore"):
            missing = np.isnan(self.measured)
            residual = np.where(missing, 0.0, (self.simulate(thetas) - self.measured) / self.sigma)
            total = self._sum_of_squares(residual)
        return np.where(np.isfinite(total), total, np.inf)

    def objective(self, thetas: Array) -> Array:
        """Compute twice the negative log posterior of every row of `thetas` (p, n): chi2 plus the prior's distance."""
        deviation = thetas - self.prior.mean
        distance: Array = np.einsum("...i,ij,...j->...", deviation, self.prior.information, deviation)
        return self.chi2(thetas) + distance

    def objective_each(self, thetas: Array) -> Array:
        """Compute the objective of each problem of the batch: (p, b, n) to (p, b)."""
        return self.objective(thetas[:, 0])[:, None]

    def sensitivity(self, theta: Array) -> Array:
        """Compute d residual / d theta by central differences kept inside the bounds, (k * m, n)."""
        if self.kernels is not None and self.kernels.sensitivity is not None:
            slope = self.kernels.sensitivity(theta) / self.sigma[:, None]
        else:
            ends, width = self._perturbed(theta)
            with np.errstate(all="ignore"):
                slope = self._differences(self.simulate(ends), width)
        return self._recorded(slope)

    def linearised(self, theta: Array) -> tuple[Array, Array]:
        """Compute `residual` and `sensitivity` at `theta` (n,), all in one batch where the states are integrated."""
        if self.trajectory is None or self.kernels is not None:
            return self.residual(theta), self.sensitivity(theta)
        ends, width = self._perturbed(theta)
        with np.errstate(all="ignore"):
            outputs = self.simulate(np.vstack([ends, theta]))
            slope = self._differences(outputs[:-1], width)
            return self._residual(outputs[-1]), self._recorded(slope)

    def linearised_each(self, theta: Array) -> tuple[Array, Array]:
        """Compute `residual` and `sensitivity` at `theta` (b, n) of each problem of the batch."""
        return self.linearised(theta[0])

    def _recorded(self, slope: Array) -> Array:
        """Return a slope (k, m, n) as rows (k * m, n), zero where no value is measured."""
        return np.where(np.isnan(self.measured)[..., None], 0.0, slope).reshape(-1, slope.shape[-1])

    def _perturbed(self, theta: Array) -> tuple[Array, Array]:
        """Return `theta` with one parameter raised, then lowered, inside the bounds (2 n, ..., n), and the widths."""
        n = theta.shape[-1]
        step = np.cbrt(np.finfo(float).eps) * np.maximum(np.abs(theta), _scale(self))
        above = np.minimum(theta + step, self.bounds[:, 1])
        below = np.maximum(theta - step, self.bounds[:, 0])
        units = np.eye(n).reshape(n, *(1,) * (theta.ndim - 1), n)
        ends = np.concatenate([theta + units * (above - theta), theta + units * (below - theta)])
        width = np.where(above > below, above - below, np.inf)
        return ends, self._of_samples(width[None])[:, 0, :, None]

    def _differences(self, outputs: Array, width: Array) -> Array:
        """Compute the slope (k, m, n) of outputs / sigma from `outputs` (2 n, k, m) at perturbed parameters."""
        n = len(width)
        slope = (outputs[:n] - outputs[n:]) / width / self.sigma
        return np.nan_to_num(np.moveaxis(slope, 0, -1), nan=0.0, posinf=1e150, neginf=-1e150)

    @property
    def _n_axes(self) -> int:
        """Number of axes of the parameters of one simulation."""
        return 1

    def _of_samples(self, values: Array) -> Array:
        """Lay out values of parameters (p, ..., n) by sample: (n, p, k), or (n, p, 1) where all samples share them."""
        return values.T[:, :, None]

    def _sum_of_squares(self, residual: Array) -> Array:
        """Sum squares of residuals (p, k, m) over samples and outputs."""
        return np.asarray(np.einsum("pkm,pkm->p", residual, residual))

    def with_prior(self, prior: Belief) -> Problem:
        """Replace the prior."""
        return replace(self, prior=prior)


def _scale(problem: Problem) -> Array:
    """Estimate a magnitude for every parameter: from its prior, else from its bounds, else from its value."""
    magnitude = np.maximum(np.abs(problem.prior.mean), np.finfo(float).tiny)
    for candidate in (problem.bounds[:, 1] - problem.bounds[:, 0], problem.prior.sd):
        magnitude = np.where(np.isfinite(candidate) & (candidate > 0.0), candidate, magnitude)
    return 1e-3 * magnitude
