"""Pool packs partially: shrink each pack's estimate towards its operator and its fleet by its uncertainty."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.records.keys import PACK

SPREADS = np.array([0.0, 0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4])
"""Grid of sds between operators, and between packs of one, as shares of the sd over all packs."""


@dataclass(frozen=True, slots=True)
class PooledLevel:
    """Level of one operator (`tail` and `pack` null) or one pack, pooled with its fleet."""

    operator: str
    tail: str | None
    pack: int | None
    parameter: str
    value: float
    sd: float
    n_flights: int


class PoolingResult(NamedTuple):
    """Posterior means and standard deviations: of the fleet, of each operator (o,) and of each pack (n,)."""

    fleet: float
    fleet_sd: float
    operator: Array
    operator_sd: Array
    pack: Array
    pack_sd: Array


def levels_of(packs: pl.DataFrame, parameter: str) -> tuple[PoolingResult, tuple[PooledLevel, ...]]:
    """Pool a quantity; return levels of each operator and pack.

    Parameters
    ----------
    packs : DataFrame
        `operator, tail, pack, value, error_sd, n`: each pack's own estimate, from `n` flights.
    """
    codes, operator = np.unique(packs["operator"].to_numpy(), return_inverse=True)
    result = pool(packs["value"].to_numpy().astype(float), packs["error_sd"].to_numpy().astype(float), operator)
    flights = np.bincount(operator, packs["n"].to_numpy(), len(codes))
    levels = [
        PooledLevel(str(o), None, None, parameter, float(m), float(s), int(n))
        for o, m, s, n in zip(codes, result.operator, result.operator_sd, flights, strict=True)
    ]
    rows = packs.select(*PACK, "n").rows()
    levels += [
        PooledLevel(operator, tail, int(pack), parameter, float(m), float(s), int(n))
        for (operator, tail, pack, n), m, s in zip(rows, result.pack, result.pack_sd, strict=True)
    ]
    return result, tuple(levels)


def pool(value: Array, error_sd: Array, operator: Array) -> PoolingResult:
    r"""Pool packs within operators within a fleet, with the sds between them integrated out.

    Parameters
    ----------
    value, error_sd : array (n,)
        Each pack's own estimate and its standard error; `value` NaN without data.
    operator : array of int (n,)
        Operator of each pack, counted from 0.

    Notes
    -----
    .. math:: y_i = \mu + a_{o(i)} + b_i + e_i, \quad a \sim N(0, \tau_o^2), \; b \sim N(0, \tau_p^2)

    with a flat prior on the mean and on the grid of spreads.

    References
    ----------
    .. [1] A. Gelman et al., Bayesian Data Analysis, 3rd ed., 2013, sections 5.4 and 5.5.
    """
    is_known = np.isfinite(value) & np.isfinite(error_sd)
    n_operators = int(operator.max()) + 1 if len(operator) else 0
    if not is_known.any():
        return PoolingResult(*(np.nan, np.nan), *np.full((2, n_operators), np.nan), *np.full((2, len(value)), np.nan))
    scale = max(float(np.std(value[is_known])), float(np.median(error_sd[is_known])), 1e-12)
    cases = [
        _posterior(value, error_sd, operator, is_known=is_known, tau_operator=scale * a, tau_pack=scale * b)
        for a in (SPREADS if n_operators > 1 else SPREADS[:1])
        for b in SPREADS[1:]
    ]
    log = np.array([c[0] for c in cases])
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    mean = weight @ np.array([c[1] for c in cases])
    square = weight @ np.array([c[2] + c[1] ** 2 for c in cases])
    sd = np.sqrt(np.maximum(square - mean**2, 0.0))
    sections = [1, 1 + n_operators]
    (fleet, operators, packs), (fleet_sd, operators_sd, packs_sd) = np.split(mean, sections), np.split(sd, sections)
    return PoolingResult(float(fleet[0]), float(fleet_sd[0]), operators, operators_sd, packs, packs_sd)


def _posterior(
    value: Array, error_sd: Array, operator: Array, *, is_known: Array, tau_operator: float, tau_pack: float
) -> tuple[float, Array, Array]:
    """Compute log evidence, means and variances of (fleet, operators, packs) for given sds, in closed form."""
    y = value[is_known]
    variance = error_sd[is_known] ** 2 + tau_pack**2
    group = operator[is_known]
    n = int(operator.max()) + 1
    weight = np.bincount(group, 1.0 / variance, n)
    with np.errstate(divide="ignore", invalid="ignore"):
        operator_mean = np.where(weight > 0.0, np.bincount(group, y / variance, n) / weight, 0.0)
        operator_var = np.where(weight > 0.0, 1.0 / weight, np.inf)
        gain = np.where(is_known, tau_pack**2 / (error_sd**2 + tau_pack**2), 0.0)
    total = 1.0 / (operator_var + tau_operator**2)
    fleet_var = 1.0 / total.sum()
    fleet = fleet_var * (total * operator_mean).sum()
    share = tau_operator**2 * total
    operators = fleet + share * (operator_mean - fleet)
    operators_var = (1.0 - share) * tau_operator**2 + (1.0 - share) ** 2 * fleet_var
    packs = operators[operator] + gain * (np.where(is_known, value, 0.0) - operators[operator])
    packs_var = (1.0 - gain) * tau_pack**2 + (1.0 - gain) ** 2 * operators_var[operator]
    within_groups = (np.log(variance) + (y - operator_mean[group]) ** 2 / variance).sum()
    present = weight > 0.0
    square = total[present] * (operator_mean[present] - fleet) ** 2
    between_groups = (np.log(weight[present] / total[present]) + square).sum()
    evidence = -0.5 * (within_groups + between_groups + np.log(total.sum()))
    return (
        float(evidence),
        np.r_[fleet, operators, packs],
        np.r_[fleet_var, operators_var, packs_var],
    )
