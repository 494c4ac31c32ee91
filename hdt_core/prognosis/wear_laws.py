"""Laws by which a declared component may wear: the declared one, or several by how well they fit the fleet's past."""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.components import Component
from hdt_core.components.wear_law import LINEAR, RESISTANCE, WearLaw, power_law
from hdt_core.records.keys import PACK
from hdt_core.robust import Array


class WeighedLaw(NamedTuple):
    """A law and its probability."""

    law: WearLaw
    weight: float


UNDECLARED = (
    WeighedLaw(LINEAR, 0.5),
    WeighedLaw(RESISTANCE, 0.2),
    WeighedLaw(power_law(0.5), 0.1),
    WeighedLaw(power_law(2.0), 0.2),
)
"""Laws where none is declared, before any life."""
EVERY_FLIGHTS, LEAST_FLIGHTS, LEAST_GAIN = 10, 60, 0.08
"""Flights between the values of a life that count; flights and gain of the loss from which a life has a curvature."""
TRACK_SD = 0.02
"""Deviation of a tracked loss from a law over a life: the filter's, and that of a rate that changes. [-]"""


def wear_laws(component: Component, past: pl.DataFrame) -> tuple[WeighedLaw, ...]:
    """Return the laws of a component's wear, their weights adding up to 1.

    Parameters
    ----------
    past : DataFrame
        Of `component_features`, the flights on record.
    """
    if component.wear_law is not None:
        return (WeighedLaw(component.wear_law, 1.0),)
    log = np.log([x.weight for x in UNDECLARED])
    for life in _tracks(past):
        log += [_log_likelihood(life, x.law) for x in UNDECLARED]
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    return tuple(x._replace(weight=float(w)) for x, w in zip(UNDECLARED, weight, strict=True))


def _tracks(past: pl.DataFrame) -> list[Array]:
    """Return the losses of lives since a wash or from new, every so many flights."""
    began = pl.int_range(pl.len()).over(PACK) - pl.col("flights_since_drop")
    flights = past.sort(*PACK, "departed_at", "flight_id").with_columns(began=began).drop_nulls("loss")
    rows = flights.filter(pl.col("flights_since_drop") % EVERY_FLIGHTS == EVERY_FLIGHTS - 1)
    lives = rows.group_by(*PACK, "began", maintain_order=True).agg("loss")["loss"]
    tracks = [np.array(values) for values in lives.to_list() if len(values) >= LEAST_FLIGHTS // EVERY_FLIGHTS]
    return [x for x in tracks if x[-1] - x[0] >= LEAST_GAIN]


def _log_likelihood(loss: Array, law: WearLaw) -> float:
    """Compute the log likelihood of a life's losses, at a rate of its own, without its constant."""
    grown = law.grown(loss)
    by_loss = law.slope(loss)
    flights = np.arange(len(loss), dtype=float)
    weight = 1.0 / by_loss
    fit = np.polynomial.polynomial.polyfit(flights, grown, 1, w=weight)
    off = (grown - np.polynomial.polynomial.polyval(flights, fit)) * weight
    return float(-0.5 * (off @ off) / TRACK_SD**2)
