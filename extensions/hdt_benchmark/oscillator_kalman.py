"""Extended and unscented Kalman filter of the spring-mass-damper, compiled: `hdt_core.estimation.kalman` for one
model.

Joint vector: position, velocity, damping, stiffness. Position steps and is observed linearly and the parameters
stand still, so only the row of the velocity needs a tangent or a regression. Start known, no process noise, no drift.
"""

from __future__ import annotations

import numpy as np

from hdt_core.estimation.compiled import compiled
from hdt_core.estimation.problem import Array

LIFTS = np.array([0.0, 1e-14, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2])


@compiled
def kalman(
    force_n: Array, dt_s: float, mass_kg: float, measured_m: Array, sigma_m: float,
    prior_mean: Array, prior_cov: Array, unknown: Array, lower: Array, upper: Array, sigma_points: bool,
    smoother_passes: int, still_sd: float,
) -> tuple[Array, Array, Array, Array, int]:  # fmt: skip
    """Forward, and at most `smoother_passes` times smoothed and forward again: until the parameters move by no more
    than `still_sd` standard deviations. Parameters that are `unknown` start again from where they last ended.

    Returns
    -------
    path, path_sd : array (k, 2)
        Of the first pass.
    mean : array (2,)
    cov : array (2, 2)
    n_passes : int
        Passes after the first.
    """
    k = force_n.size
    start = np.zeros((J, J))
    start[2:, 2:] = prior_cov
    means = np.empty((k, J))
    covs = np.empty((k, J, J))
    rows = np.empty((k, J))
    gains = np.empty((k, J))
    innovations = np.empty(k)
    precisions = np.empty(k)
    n_smoothed = k if smoother_passes > 0 else 1
    about = np.empty((n_smoothed, J))
    about_cov = np.empty((n_smoothed, J, J))
    path = np.empty((k, 2))
    path_sd = np.empty((k, 2))
    before = np.zeros(2)
    n_passes = 0
    centre = prior_mean.copy()
    for turn in range(smoother_passes + 1):
        if turn > 0:
            for j in range(2):
                before[j] = means[-1, 2 + j]
                centre[j] = before[j] if unknown[j] else prior_mean[j]
            smooth(means, covs, rows, gains, innovations, precisions, dt_s, about, about_cov)
        _forward(
            force_n, dt_s, mass_kg, measured_m, sigma_m, centre, start, lower, upper, sigma_points,
            turn > 0, about, about_cov, means, covs, rows, gains, innovations, precisions,
        )  # fmt: skip
        if turn == 0:
            for i in range(k):
                path[i, 0], path[i, 1] = means[i, 2], means[i, 3]
                path_sd[i, 0] = np.sqrt(max(covs[i, 2, 2], 0.0))
                path_sd[i, 1] = np.sqrt(max(covs[i, 3, 3], 0.0))
        else:
            n_passes = turn
            still = True
            for j in range(2):
                still = still and abs(means[-1, 2 + j] - before[j]) <= still_sd * np.sqrt(
                    max(covs[-1, 2 + j, 2 + j], 0.0)
                )
            if still:
                break
    return path, path_sd, means[-1, 2:].copy(), covs[-1, 2:, 2:].copy(), n_passes


@compiled
def _forward(
    force_n: Array, dt_s: float, mass_kg: float, measured_m: Array, sigma_m: float, prior_mean: Array, start: Array,
    lower: Array, upper: Array, sigma_points: bool, again: bool, about: Array, about_cov: Array,
    means: Array, covs: Array, rows: Array, gains: Array, innovations: Array, precisions: Array,
) -> float:  # fmt: skip
    m = np.zeros(J)
    p = start.copy()
    row = np.zeros(J)
    spread = np.zeros(2)
    work = np.zeros((J, J))
    m[2:] = prior_mean
    for j in range(2):
        m[2 + j] = min(max(m[2 + j], lower[j]), upper[j])
    nis = 0.0
    n_seen = 0
    for i in range(force_n.size):
        precisions[i] = innovations[i] = 0.0
        for a in range(J):
            gains[i, a] = 0.0
        if not np.isnan(measured_m[i]):
            nis += _correct(m, p, measured_m[i], sigma_m, gains, innovations, precisions, i)
            n_seen += 1
        for a in range(J):
            means[i, a] = m[a]
            for b in range(J):
                covs[i, a, b] = p[a, b]
        if i + 1 == force_n.size:
            break
        centre, cov = (about[i], about_cov[i]) if again else (m, p)
        if sigma_points:
            _regress(centre, cov, force_n[i], dt_s / mass_kg, lower, upper, row, spread, work)
        else:
            _tangent(centre, force_n[i], dt_s / mass_kg, lower, upper, row, spread)
        for a in range(J):
            rows[i, a] = row[a]
        _step(m, p, row, spread, dt_s)
    return float(nis / max(n_seen, 1))


@compiled
def _correct(
    m: Array, p: Array, measurement: float, sigma_m: float, gains: Array, innovations: Array, precisions: Array, i: int
) -> float:
    """Update by one position, which is the first component."""
    variance = p[0, 0] + sigma_m**2
    innovation = measurement - m[0]
    precision = 1.0 / variance
    precisions[i], innovations[i] = precision, innovation
    for a in range(J):
        gains[i, a] = p[a, 0] * precision
    for a in range(J):
        m[a] += gains[i, a] * innovation
        for b in range(a + 1):
            p[a, b] -= gains[i, a] * gains[i, b] * variance  # what Joseph's form is for the optimal gain
            p[b, a] = p[a, b]
    return float(innovation * innovation * precision)


@compiled
def _tangent(m: Array, force: float, h: float, lower: Array, upper: Array, row: Array, spread: Array) -> None:
    """Row of the velocity's step, its offset in spread[0], no variance in spread[1]."""
    c = min(max(m[2], lower[0]), upper[0])
    k = min(max(m[3], lower[1]), upper[1])
    row[0], row[1], row[2], row[3] = -h * k, 1.0 - h * c, -h * m[1], -h * m[0]
    spread[0] = h * (force + c * m[1] + k * m[0])
    spread[1] = 0.0


@compiled
def _regress(
    m: Array, p: Array, force: float, h: float, lower: Array, upper: Array, row: Array, spread: Array, root: Array
) -> None:
    """The same by regression over eight sigma points of equal weight."""
    _cholesky(p, root)
    far = np.sqrt(float(J))
    values = np.zeros((2, J))
    half = np.zeros(J)
    mean = 0.0
    for a in range(J):
        for sign in range(2):
            push = far if sign == 0 else -far
            x = m[0] + push * root[0, a]
            v = m[1] + push * root[1, a]
            c = min(max(m[2] + push * root[2, a], lower[0]), upper[0])
            k = min(max(m[3] + push * root[3, a], lower[1]), upper[1])
            values[sign, a] = v + h * (force - c * v - k * x)
            mean += values[sign, a] / (2.0 * J)
        half[a] = 0.5 * (values[0, a] - values[1, a]) / far
    for a in range(J - 1, -1, -1):  # row @ root = half, the root lower triangular
        row[a] = half[a]
        for b in range(a + 1, J):
            row[a] -= row[b] * root[b, a]
        row[a] /= root[a, a]
    spread[0] = mean
    spread[1] = 0.0
    for a in range(J):
        spread[0] -= row[a] * m[a]
        for sign in range(2):
            residual = values[sign, a] - mean - (1.0 if sign == 0 else -1.0) * far * half[a]
            spread[1] += residual * residual / (2.0 * J)


@compiled
def _cholesky(p: Array, root: Array) -> None:
    """Lower root of a covariance that may have lost its definiteness; as `hdt_core.estimation.kalman.upper_root`."""
    size = np.zeros(J)
    for a in range(J):
        size[a] = np.sqrt(max(p[a, a], 0.0))
    floor = 1e-6 * max(size.max(), 1e-6)
    for a in range(J):
        if size[a] == 0.0:
            size[a] = floor
    for lift in LIFTS:
        definite = True
        for b in range(J):
            for a in range(b, J):
                total = 1.0 + lift if a == b else p[a, b] / (size[a] * size[b])
                for c in range(b):
                    total -= root[a, c] * root[b, c]
                if a == b:
                    definite = definite and total > 0.0
                    root[a, a] = np.sqrt(total) if total > 0.0 else 1.0
                else:
                    root[a, b] = total / root[b, b]
        if definite:
            break
    for a in range(J):
        for b in range(a + 1):
            root[a, b] *= size[a]


@compiled
def _step(m: Array, p: Array, row: Array, spread: Array, dt_s: float) -> None:
    """Mean and covariance one sample later: only the first two rows of the step differ from the unit matrix."""
    velocity = spread[0]
    for a in range(J):
        velocity += row[a] * m[a]
    m[0] += dt_s * m[1]
    m[1] = velocity
    for b in range(J):
        later = row[0] * p[0, b] + row[1] * p[1, b] + row[2] * p[2, b] + row[3] * p[3, b]
        p[0, b] += dt_s * p[1, b]
        p[1, b] = later
    for a in range(J):
        later = row[0] * p[a, 0] + row[1] * p[a, 1] + row[2] * p[a, 2] + row[3] * p[a, 3]
        p[a, 0] += dt_s * p[a, 1]
        p[a, 1] = later
    p[1, 1] += spread[1]
    for a in range(J):
        for b in range(a):
            p[a, b] = p[b, a] = 0.5 * (p[a, b] + p[b, a])


J = 4  # position, velocity, damping, stiffness


@compiled
def smooth(
    means: Array, covs: Array, rows: Array, gains: Array, innovations: Array, precisions: Array, dt_s: float,
    about: Array, about_cov: Array,
) -> None:  # fmt: skip
    """Beliefs given the whole record into `about` (k, J) and `about_cov` (k, J, J), by Bryson and Frazier's
    adjoint."""
    pull = np.zeros(J)
    weight = np.zeros((J, J))
    half = np.zeros((J, J))
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
    x = pull[0]
    v = pull[1]
    pull[0], pull[1] = x + row[0] * v, dt_s * x + row[1] * v
    pull[2] += row[2] * v
    pull[3] += row[3] * v
    for b in range(J):
        x = weight[0, b]
        v = weight[1, b]
        weight[0, b], weight[1, b] = x + row[0] * v, dt_s * x + row[1] * v
        weight[2, b] += row[2] * v
        weight[3, b] += row[3] * v
    for a in range(J):
        x = weight[a, 0]
        v = weight[a, 1]
        weight[a, 0], weight[a, 1] = x + row[0] * v, dt_s * x + row[1] * v
        weight[a, 2] += row[2] * v
        weight[a, 3] += row[3] * v
