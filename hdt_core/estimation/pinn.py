"""Physics-informed neural network: a small net for the trajectory, trained with the parameters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from hdt_core.estimation.conclude import conclude, settle
from hdt_core.estimation.damped import FIRST_DAMPING
from hdt_core.estimation.estimate import Estimate
from hdt_core.estimation.problem import Array, Observe, Problem, Sample

STILL_SD = 3e-4  # of its standard deviation: a parameter that a step moves by less has settled
STILL_STEPS = 3  # in a row; the net's own weights may still change, they are not reported


class _Scale(NamedTuple):
    """Time of every sample from 0 to 1 (k,), and typical size and change per sample of every state, (s,) each."""

    time: Array
    size: Array
    change: Array


@dataclass(frozen=True, slots=True)
class PhysicsInformedNet:
    r"""Train a net x(t) and the parameters on one loss, on the CPU, in NumPy.

    .. math:: L = \sum_i \left|\frac{h(\hat x_i, \theta) - y_i}{\sigma}\right|^2
              + \sum_i \left|\frac{\hat x_{i+1} - f(\hat x_i, \theta)}{\rho\, d}\right|^2 + \text{start} + \text{prior}

    where d is the typical change of a state per sample. The physics' weight grows in stages as :math:`\rho` falls:
    first the net learns the record, then the record's physics. Since the loss is a sum of squares, training is
    Levenberg and Marquardt's on all weights, which needs tens of steps where a first-order optimiser needs thousands.

    A problem without states has no differential equation and nothing for a net to represent: there the loss is least
    squares, and so is this method. `Estimate.method` reports it.

    Parameters
    ----------
    width : int
        Hidden units.
    stages : tuple of float
        Values of rho.
    max_steps : int
        Training steps of each stage.
    polish : bool
        Finish with least squares on the equations themselves, which takes away the bias of the order of rho.
    seed : int

    Notes
    -----
    Training ends when the parameters settle, three steps in a row that move each by less than 0.0003 of its
    standard deviation. The net still changes for hundreds of steps, which would move them by another 0.03.

    Deterministic equations leave a net no freedom, so its remaining misfit of the physics, which it cannot help,
    shows as a bias of the parameters of the order of rho. The covariance stated is that of the loss: it takes rho
    for process noise.

    References
    ----------
    .. [1] M. Raissi, P. Perdikaris and G. Karniadakis, Physics-informed neural networks, J. Comput. Phys. 378, 2019.
    """

    name: str = "pinn"
    width: int = 30
    stages: tuple[float, ...] = (0.1, 0.01)
    max_steps: int = 100
    polish: bool = True
    seed: int = 0

    def estimate(self, problem: Problem) -> Estimate:
        """Train the net and the parameters; return the parameters."""
        if problem.transition is None:
            return settle(problem, problem.origin, 0, method=f"{self.name}: least squares, no dynamics")
        guess = _simulate_states(problem)
        if not np.isfinite(guess).all():
            return conclude(problem, problem.origin * np.nan, "diverged", 1, method=self.name)
        scale = _Scale(
            np.linspace(0.0, 1.0, len(guess)),
            np.maximum(np.abs(guess).max(axis=0), 1e-9),
            np.maximum(np.abs(np.diff(guess, axis=0)).mean(axis=0), 1e-12),
        )
        first = _first_weights(self.width, guess, scale, np.random.default_rng(self.seed))
        vector = np.concatenate([first, problem.origin])
        steps, normal = 0, np.eye(vector.size)
        for rho in self.stages:
            vector, normal, n_steps = _train(problem, vector, scale, rho, width=self.width, max_steps=self.max_steps)
            steps += n_steps
        n = problem.prior.mean.size
        passes = steps * (1 + 2 * (problem.start.mean.size + n))
        cov = _parameter_cov(normal, n)
        return settle(problem, vector[-n:], passes, polish=self.polish, cov=cov, method=self.name)


def _simulate_states(problem: Problem) -> Array:
    """Simulate states along the record at the guess, (k, s)."""
    assert problem.transition is not None
    states = np.empty((len(problem.measured), problem.start.mean.size))
    states[0] = problem.start.mean
    for i in range(len(states) - 1):
        states[i + 1] = problem.transition(states[i], problem.origin, i)
    return states


def _first_weights(width: int, guess: Array, scale: _Scale, rng: np.random.Generator) -> Array:
    """Initialise units evenly over the record, each a few spacings wide, and fit them to the guess."""
    slope = width * rng.uniform(0.3, 1.0, width) * rng.choice([-1.0, 1.0], width)
    shift = -slope * np.linspace(-0.05, 1.05, width)
    activation = np.column_stack([np.tanh(np.outer(scale.time, slope) + shift), np.ones(len(guess))])
    ridge = 1e-6 * len(guess) * np.eye(width + 1)
    weights = np.linalg.solve(activation.T @ activation + ridge, activation.T @ (guess / scale.size))
    return np.concatenate([slope, shift, weights[:-1].ravel(), weights[-1]])


def _train(
    problem: Problem, vector: Array, scale: _Scale, rho: float, *, width: int, max_steps: int
) -> tuple[Array, Array, int]:
    """Train net and parameters by Levenberg and Marquardt: vector, its J^T J, steps."""
    residual, slope = _loss(problem, vector, scale, rho, width)
    cost, damping, n_still, steps = float(residual @ residual), FIRST_DAMPING, 0, 0
    normal, n = slope.T @ slope, problem.prior.mean.size
    while steps < max_steps and n_still < STILL_STEPS:
        steps += 1
        gradient, size = slope.T @ residual, np.diag(normal) + 1e-12
        while True:
            move = np.linalg.solve(normal + damping * np.diag(size), -gradient)
            trial = vector + move
            trial[-n:] = np.clip(trial[-n:], *problem.bounds.T)
            new_residual, new_slope = _loss(problem, trial, scale, rho, width)
            new_cost = float(new_residual @ new_residual)
            if new_cost < cost or damping > 1e8:
                break
            damping *= 4.0
        if new_cost >= cost:  # no step lowers the cost: the minimum, to rounding
            break
        still_sd = STILL_SD * np.sqrt(np.diag(_parameter_cov(normal, n)))
        free = damping <= FIRST_DAMPING  # a step held back by damping is short for another reason
        n_still = n_still + 1 if free and (np.abs(move[-n:]) <= still_sd).all() else 0
        vector, residual, slope, cost, damping = trial, new_residual, new_slope, new_cost, damping * 0.2
        normal = slope.T @ slope
    return vector, normal, steps


def _parameter_cov(normal: Array, n: int) -> Array:
    """Compute the covariance (n, n) of the parameters, which come last, ignoring net directions without information."""
    size = np.sqrt(np.diag(normal) + 1e-12)
    scaled_normal = normal / np.outer(size, size) + 1e-12 * np.eye(size.size)
    cov = np.linalg.solve(scaled_normal, np.eye(size.size)[:, -n:])[-n:] / np.outer(size[-n:], size[-n:])
    return np.asarray(0.5 * (cov + cov.T))


def _loss(problem: Problem, vector: Array, scale: _Scale, rho: float, width: int) -> tuple[Array, Array]:
    """Compute residuals of the loss and their Jacobian by everything trained."""
    time, size = scale.time, scale.size
    s, n, k = size.size, problem.prior.mean.size, time.size
    theta = vector[-n:]
    states, by_weights = _states(vector[:-n], time, size, width)
    index = np.arange(k)
    modelled, modelled_x, modelled_theta = _with_slopes(problem.observe, states, theta, index)
    assert problem.transition is not None
    next_states, next_x, next_theta = _with_slopes(problem.transition, states[:, :-1], theta, index[:-1])
    change = rho * scale.change[:, None]
    is_recorded = ~np.isnan(problem.measured.T)
    error = modelled - np.where(is_recorded, problem.measured.T, 0.0)
    data = np.where(is_recorded, error / problem.sigma[:, None], 0.0)
    weight = is_recorded / problem.sigma[:, None]
    start_sd = np.maximum(np.sqrt(np.diag(problem.start.cov)), 1e-3 * size)
    root = np.linalg.cholesky(problem.prior.information + 1e-30 * np.eye(n)).T
    rows = [
        (
            data,
            np.einsum("mk,msk,skw->mkw", weight, modelled_x, by_weights),
            weight[..., None] * np.moveaxis(modelled_theta, 1, 2),
        ),
        (
            (states[:, 1:] - next_states) / change,
            (by_weights[:, 1:] - np.einsum("ask,skw->akw", next_x, by_weights[:, :-1])) / change[..., None],
            -np.moveaxis(next_theta, 1, 2) / change[..., None],
        ),
        ((states[:, 0] - problem.start.mean) / start_sd, by_weights[:, 0] / start_sd[:, None], np.zeros((s, n))),
        (root @ (theta - problem.prior.mean), np.zeros((n, vector.size - n)), root),
    ]
    residual = np.concatenate([r.ravel() for r, _, _ in rows])
    jacobian = np.concatenate([np.hstack([w.reshape(r.size, -1), t.reshape(r.size, n)]) for r, w, t in rows])
    return residual, jacobian


def _states(weights: Array, time: Array, size: Array, width: int) -> tuple[Array, Array]:
    """Compute states (s, k) of the net and their derivatives by its weights, (s, k, w).

    One layer of tanh: slopes and shifts of the units, their weights (units, s), offsets (s,).
    """
    s = size.size
    slope, shift, weight, offset = np.split(weights, (width, 2 * width, weights.size - s))
    weight = weight.reshape(width, s)
    activation = np.tanh(np.outer(time, slope) + shift)
    states = size[:, None] * (activation @ weight + offset).T
    activation_slope = 1.0 - activation**2
    by = np.zeros((s, time.size, weights.size))
    for j in range(s):
        by[j, :, width : 2 * width] = size[j] * activation_slope * weight[:, j]
        by[j, :, :width] = by[j, :, width : 2 * width] * time[:, None]
        by[j, :, 2 * width + j : weights.size - s : s] = size[j] * activation
        by[j, :, weights.size - s + j] = size[j]
    return states, by


def _with_slopes(function: Observe, states: Array, theta: Array, index: Sample) -> tuple[Array, Array, Array]:
    """Evaluate a function (r, k) along the record, with derivatives by states (r, s, k) and parameters (r, n, k)."""
    n_states = len(states)
    arguments = np.concatenate([states, np.repeat(theta[:, None], states.shape[1], axis=1)])

    def value(columns: Array) -> Array:
        return np.asarray(function(columns[:n_states], columns[n_states:], index))

    slopes = []
    for j, row in enumerate(arguments):
        step = 6e-6 * max(float(np.abs(row).max()), 1e-3)
        above, below = arguments.copy(), arguments.copy()
        above[j] += step
        below[j] -= step
        slopes.append((value(above) - value(below)) / (2.0 * step))
    slope = np.stack(slopes, axis=1)
    return value(arguments), slope[:, :n_states], slope[:, n_states:]
