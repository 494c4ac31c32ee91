"""Flights of many packs as a panel for the filter: side by side, the k-th of each together."""

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.records.keys import LEG_AT, split_packs
from hdt_core.records.unit_index import RENEWALS, log_flags, log_kept
from hdt_core.tracking.wear_model import Observation

FILTERED = "kalman_filtered"
"""Estimator of a value from its flight and earlier ones."""


class FlightPanel(NamedTuple):
    """Flights of all packs side by side, (flights, packs); `row` is the row in the frame, -1 where a pack has no
    more."""

    row: Array
    observations: Observation

    @property
    def n_rows(self) -> int:
        """Rows of the frame."""
        return int((self.row >= 0).sum())

    @property
    def flights(self) -> Array:
        """Number of flights of each pack. (packs,)"""
        return np.asarray((self.row >= 0).sum(axis=0))


def lay_out(
    flights: pl.DataFrame,
    observations: tuple[Array, Array, Array],
    maintenance: pl.DataFrame,
    component: str,
    actions: Sequence[str] = RENEWALS,
    unchecked: Array | None = None,
) -> FlightPanel:
    """Lay out ratio, variance and exposure of each row of `flights` (in order), and the log of a component.

    Without `unchecked` no sensor is redundant.
    """
    packs = split_packs(flights)
    index = np.full((max(map(len, packs)), len(packs) if flights.height else 0), -1)
    for pack, rows in enumerate(packs):
        index[: len(rows), pack : pack + 1] = rows[:, None]
    log = (*log_flags(flights, maintenance, component, actions), log_kept(flights, maintenance))
    share = np.ones(flights.height) if unchecked is None else unchecked
    columns = zip((*observations, *log, share), (np.nan, 1.0, 1.0, 0, 0, 0, 1.0), strict=True)
    return FlightPanel(
        index, Observation(*(np.where(index >= 0, values[np.maximum(index, 0)], empty) for values, empty in columns))
    )


def fingerprints(panel: FlightPanel, inputs: list[Array], names: list[str], seal: str, segment: int) -> list[list[str]]:
    """Digest each pack's flights before flight 0, `segment`, twice `segment` ...: equal only for equal flights.

    Parameters
    ----------
    panel : FlightPanel
        The observations of each flight.
    inputs : list of array, each (rows,)
        Further inputs of a row's result.
    names : list of str, (rows,)
        Flights' names.
    seal : str
        All else that results rest on.
    """
    digests = []
    for pack, n in enumerate(panel.flights):
        rows = panel.row[:n, pack]
        columns = [*(v[:n, pack] for v in panel.observations), *(values[rows] for values in inputs)]
        matrix = np.column_stack(columns).astype(float)
        digest, pack_digests = hashlib.blake2b(seal.encode(), digest_size=10), []
        for first in range(0, n, segment):
            pack_digests.append(digest.copy().hexdigest())
            digest.update(matrix[first : first + segment].tobytes())
            digest.update("|".join(names[r] for r in rows[first : first + segment]).encode())
        digests.append(pack_digests)
    return digests


def health_rows(
    flights: pl.DataFrame,
    names: tuple[str, str, str, str],
    value: Array | pl.Series,
    sd: Array | pl.Series,
    status: pl.Expr,
) -> pl.DataFrame:
    """Build rows of one parameter in long form; `names` are component, parameter, unit and estimator."""
    component, parameter, unit, estimator = map(pl.lit, names)
    columns = {"component": component, "parameter": parameter, "unit": unit, "status": status, "estimator": estimator}
    rows = flights.select(*LEG_AT, value=pl.Series(value), sd=pl.Series(sd), **columns)
    return rows.select(*LEG_AT, "component", "parameter", "value", "sd", "unit", "status", "estimator")
