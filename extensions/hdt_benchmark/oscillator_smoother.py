"""The backward pass of the spring-mass-damper's filters, compiled: `hdt_core.estimation.kalman.smooth` for one
model."""

from __future__ import annotations

import numpy as np

from hdt_core.estimation.compiled import compiled
from hdt_core.estimation.problem import Array

J = 4  # position, velocity, damping, stiffness


@compiled
def smooth(
    means: Array, covs: Array, rows: Array, gains: Array, innovations: Array, precisions: Array, dt_s: float,
    about: Array, about_cov: Array,
) -> None:  # fmt: skip
    """Beliefs given the whole record into `about` (k, J) and `about_cov` (k, J, J), by Bryson and Frazier's
    adjoint."""
    pull, weight, half = np.zeros(J), np.zeros((J, J)), np.zeros((J, J))
    for i in range(len(means) - 1, -1, -1):
        _given_the_rest(means[i], covs[i], pull, weight, half, about[i], about_cov[i])
        # kept' = I - e0 gain': only the first row and column change
        first = -precisions[i] * innovations[i]
        for a in range(J):
            first -= gains[i, a] * pull[a]
            half[0, a] = 0.0
            for b in range(J):
                half[0, a] += gains[i, b] * weight[b, a]
        corner = precisions[i]
        for a in range(J):
            corner += gains[i, a] * half[0, a]
        pull[0] += first
        for a in range(J):
            weight[0, a] -= half[0, a]
            weight[a, 0] -= half[0, a]
        weight[0, 0] += corner
        if i > 0:
            _back(pull, weight, rows[i - 1], dt_s)


@compiled
def _given_the_rest(
    mean: Array, p: Array, pull: Array, weight: Array, half: Array, about: Array, about_cov: Array
) -> None:
    """Mean - P pull, and P - P weight P."""
    for a in range(J):
        about[a] = mean[a]
        for b in range(J):
            about[a] -= p[a, b] * pull[b]
            half[a, b] = 0.0
            for c in range(J):
                half[a, b] += p[a, c] * weight[c, b]
    for a in range(J):
        for b in range(a + 1):
            total = p[a, b]
            for c in range(J):
                total -= half[a, c] * p[c, b]
            about_cov[a, b] = about_cov[b, a] = total


@compiled
def _back(pull: Array, weight: Array, row: Array, dt_s: float) -> None:
    """Adjoint of `_step`: transpose of its slope from the left, for the weight its slope from the right too."""
    x, v = pull[0], pull[1]
    pull[0], pull[1] = x + row[0] * v, dt_s * x + row[1] * v
    pull[2] += row[2] * v
    pull[3] += row[3] * v
    for b in range(J):
        x, v = weight[0, b], weight[1, b]
        weight[0, b], weight[1, b] = x + row[0] * v, dt_s * x + row[1] * v
        weight[2, b] += row[2] * v
        weight[3, b] += row[3] * v
    for a in range(J):
        x, v = weight[a, 0], weight[a, 1]
        weight[a, 0], weight[a, 1] = x + row[0] * v, dt_s * x + row[1] * v
        weight[a, 2] += row[2] * v
        weight[a, 3] += row[3] * v
