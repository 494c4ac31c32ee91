"""Particle filter: a cloud of parameter values, weighed by each sample, thinned and moved when it has become too
few."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.kalman_step import is_moving, upper_root
from hdt_core.estimation.problem import Array, Belief, Problem

NO_ANSWER = 1e290  # misfit where the model has none
LEAST_ACCEPTED = 0.05  # of the moves; below, the cloud repeats itself and its spread means little


@dataclass(frozen=True, slots=True)
class ParticleFilter:
    """Resample and move where the model is deterministic, resample and shrink where it is not.

    Without process noise and drift every particle has one trajectory, so the cloud can be moved by Metropolis steps
    on the whole record so far, and stays alive however sharp the likelihood becomes (Chopin 2002). With either,
    states are drawn along with the parameters, and a kernel keeps the cloud's variance (Liu and West 2001).

    Parameters
    ----------
    n_particles : int
    moves : int
        Metropolis steps after each resampling.
    shrinkage : float
        Liu and West's a.
    polish : bool
        Where nothing moves, finish with least squares from the cloud's mean, which is an average and no optimum.
    seed : int

    References
    ----------
    .. [1] N. Chopin, A sequential particle filter method for static models, Biometrika 89(3), 2002.
    .. [2] J. Liu and M. West, in Sequential Monte Carlo Methods in Practice, 2001, chapter 10.
    """

    name: str = "particle"
    n_particles: int = 400
    moves: int = 4
    shrinkage: float = 0.98
    polish: bool = True
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Mean and covariance of the cloud after the last sample; path of all. Where something moves it is
        `approximate`: an average over a cloud is right to its Monte Carlo error."""
        rng = np.random.default_rng(self.seed)
        if is_moving(problem):
            return self._bootstrap(problem, rng)
        return self._resample_move(problem, rng)

    def _resample_move(self, problem: Problem, rng: np.random.Generator) -> Estimate:
        cloud = _draw_prior(problem, self.n_particles, rng)
        misfit = _misfit(problem, cloud)
        if misfit.max(axis=1).min() >= NO_ANSWER:
            return conclude(problem, cloud[0] * np.nan, "diverged", len(cloud), method=self.name)
        path = np.empty((len(problem.measured), cloud.shape[1]))
        path_sd = np.empty((len(problem.measured), cloud.shape[1]))
        log_weight = np.zeros(len(cloud))
        accepted = 1.0
        n_evals = len(cloud)
        for i in range(len(problem.measured)):
            log_weight -= 0.5 * misfit[:, i]
            weight = _normalised(log_weight)
            if 1.0 / (weight @ weight) < 0.5 * len(cloud) or i + 1 == len(path):
                spread = _spread(cloud, weight)
                indices = _resample_indices(weight, rng)
                cloud = cloud[indices]
                misfit = misfit[indices]
                for _ in range(self.moves):
                    cloud, misfit, accepted = _move_particles(problem, cloud, misfit, spread, i=i, rng=rng)
                n_evals += self.moves * len(cloud)
                log_weight = np.zeros(len(cloud))
                weight = np.full(len(cloud), 1.0 / len(cloud))
            path[i] = weight @ cloud
            path_sd[i] = np.sqrt(weight @ (cloud - path[i]) ** 2)
        cov = np.atleast_2d(np.cov(cloud.T)) if accepted > LEAST_ACCEPTED or not self.polish else None
        fields: dict[str, Any] = {"path": path, "path_sd": path_sd, "method": self.name}
        return settle(problem, cloud.mean(axis=0), n_evals, polish=self.polish, cov=cov, **fields)

    def _bootstrap(self, problem: Problem, rng: np.random.Generator) -> Estimate:
        cloud = _draw_prior(problem, self.n_particles, rng)
        x = np.empty((len(cloud), 0))
        if problem.start.mean.size:
            x = rng.multivariate_normal(problem.start.mean, problem.start.cov, len(cloud))
        k = len(problem.measured)
        n = cloud.shape[1]
        path = np.empty((k, n))
        path_sd = np.empty((k, n))
        log_weight = np.zeros(len(cloud))
        for i in range(k):
            error = (np.asarray(problem.observe(x.T, cloud.T, i)).T - problem.measured[i]) / problem.sigma
            log_weight -= 0.5 * np.nansum(error**2, axis=1)
            weight = _normalised(log_weight)
            path[i] = weight @ cloud
            path_sd[i] = np.sqrt(weight @ (cloud - path[i]) ** 2)
            if 1.0 / (weight @ weight) < 0.5 * len(cloud):
                indices = _resample_indices(weight, rng)
                cloud, x, log_weight = cloud[indices], x[indices], np.zeros(len(cloud))
                jitter = path_sd[i] * np.sqrt(1.0 - self.shrinkage**2) * rng.standard_normal(cloud.shape)
                cloud = self.shrinkage * cloud + (1.0 - self.shrinkage) * path[i] + jitter
            cloud = _inside(problem, cloud + _noise(problem.drift, cloud.shape, rng))
            if problem.transition is not None and i + 1 < k:
                x = np.asarray(problem.transition(x.T, cloud.T, i)).T + _noise(problem.process_sd, x.shape, rng)
        weight = _normalised(log_weight)
        cov = (weight * (cloud - path[-1]).T) @ (cloud - path[-1])
        theta = np.clip(path[-1], *problem.bounds.T)
        fields: dict[str, Any] = {"path": path, "path_sd": path_sd, "method": self.name}
        return conclude(problem, theta, "approximate", len(cloud), own_objective=True, cov=cov, **fields)


def _draw_prior(problem: Problem, n: int, rng: np.random.Generator) -> Array:
    """Draw particles (n, parameters) from the prior inside the bounds; uniformly over the box where it is
    uninformative."""
    lower, upper = problem.search_box
    cloud = lower + (upper - lower) * rng.random((n, lower.size))
    has_prior = np.isfinite(problem.prior.sd)
    if has_prior.any():
        prior = Belief(problem.prior.mean[has_prior], problem.prior.cov[np.ix_(has_prior, has_prior)])
        cloud[:, has_prior] = rng.multivariate_normal(prior.mean, prior.cov, n)
    for _ in range(50):
        outside = ((cloud < lower) | (cloud > upper))[:, lower < upper].any(axis=1)
        if not outside.any():
            break
        inner = np.flatnonzero(~outside)
        cloud[outside] = cloud[rng.choice(inner, outside.sum())] if inner.size else problem.origin
    return np.clip(cloud, *problem.bounds.T)


def _move_particles(
    problem: Problem, cloud: Array, misfit: Array, spread: Array, *, i: int, rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """Move every particle by a Metropolis step for the posterior of samples 0 to i; return the acceptance rate."""
    n = cloud.shape[1]
    root = upper_root(spread)
    proposed = cloud + 2.38 / np.sqrt(n) * rng.standard_normal(cloud.shape) @ root
    inside = ((proposed >= problem.bounds[:, 0]) & (proposed <= problem.bounds[:, 1])).all(axis=1)
    new = _misfit(problem, np.where(inside[:, None], proposed, cloud))
    gain = 0.5 * (misfit[:, : i + 1].sum(axis=1) - new[:, : i + 1].sum(axis=1))
    gain += _log_prior(problem, proposed) - _log_prior(problem, cloud)
    accepted = inside & (np.log(rng.random(len(cloud))) < gain)
    return (
        np.where(accepted[:, None], proposed, cloud),
        np.where(accepted[:, None], new, misfit),
        float(accepted.mean()),
    )


def _misfit(problem: Problem, cloud: Array) -> Array:
    """Return squared normalised residuals of every particle and sample, (p, k)."""
    residual = problem.residual(cloud)
    squares: Array = np.einsum("pkm,pkm->pk", residual, residual)
    return np.minimum(squares, NO_ANSWER)


def _log_prior(problem: Problem, cloud: Array) -> Array:
    away = cloud - problem.prior.mean
    return np.asarray(-0.5 * np.einsum("pi,ij,pj->p", away, problem.prior.information, away))


def _inside(problem: Problem, cloud: Array) -> Array:
    """Reflect particles at the bounds, so that none accumulate there."""
    lower, upper = problem.bounds.T
    cloud = np.where(cloud < lower, 2.0 * lower - cloud, cloud)
    return np.clip(np.where(cloud > upper, 2.0 * upper - cloud, cloud), lower, upper)


def _noise(sd: Array | None, shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    return np.zeros(shape) if sd is None else sd * rng.standard_normal(shape)


def _spread(cloud: Array, weight: Array) -> Array:
    """Return the covariance (n, n) of a weighted cloud; zero where one particle has all the weight."""
    away = cloud - weight @ cloud
    return np.asarray((weight * away.T) @ away / max(1.0 - float(weight @ weight), 1.0 / weight.size))


def _normalised(log_weight: Array) -> Array:
    weight = np.exp(log_weight - log_weight.max())
    return np.asarray(weight / weight.sum())


def _resample_indices(weight: Array, rng: np.random.Generator) -> Array:
    """Resample systematically; return the indices of the surviving particles."""
    ticks = (rng.random() + np.arange(weight.size)) / weight.size
    return np.minimum(np.searchsorted(np.cumsum(weight), ticks), weight.size - 1)
