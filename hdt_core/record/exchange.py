"""Find flights on which an aircraft's packs were recorded in each other's place, from a new decoding map on.

What distinguishes two packs (offsets of sensors, ducts, wear, the flow they are set to) keeps its sign from flight to
flight. Where all of it changes sign between two flights and keeps its size, the packs changed places on record: wear, a
wash or one faulty sensor changes a part of it.
"""

from collections.abc import Sequence
from math import sqrt

import numpy as np
import polars as pl

from hdt_core.records.keys import AIRCRAFT, FLIGHT
from hdt_core.robust import MAD_TO_SD, Array

PACKS = (1, 2)
"""Packs that an aircraft has, by number."""
EXCHANGED = "packs_exchanged"
"""Reason of flights that are used, each pack in its own place."""
BETWEEN_PACKS = {
    "hx_in_between_packs_k": "hx_in_k",
    "hx_out_between_packs_k": "hx_out_k",
    "cc_in_between_packs_k": "cc_in_k",
    "ram_door_between_packs": "ram_door_open",
    "pack_flow_between_packs_kg_s": "pack_flow_kg_s",
    "cc_speed_between_packs_rad_s": "cc_speed_rad_s",
    "cc_in_between_packs_pa": "cc_in_pa",
    "cc_out_between_packs_pa": "cc_out_pa",
}
"""Signals that distinguish two packs, by the column of pack 1's mean above pack 2's."""
MOST_FLIGHTS, LEAST_FLIGHTS = 20, 8
"""Flights on one side of another that show how an aircraft's packs differ, at most and at least."""
AFTER = 5
"""Flights after the change that must show it: less than two days."""
CLEAR = 0.8
"""Difference of the packs that counts, in its standard deviations from flight to flight."""
LEAST_CLEAR = 3
"""Signals that must differ clearly; one of them a temperature, another a flow, speed or pressure."""
LEAST_EVIDENCE = 30.0
"""Sum of squares of the clear differences over the flights after the change; noise alone gives about a fifth of it."""
REVERSED = -0.2
"""Ratio of each clear difference after to that before which is at most so, and -1 but for noise."""
TO_BEGIN, TO_END = 0.8, 0.6
"""Shares of the clear differences that must be reversed on an aircraft one exchange of which is known."""
MEDIAN_TOLERANCE = 0.6
"""Deviation of the median ratio from -1."""
MAX_CHANGES = 20
"""Changes of one aircraft that are followed."""
_IS_TEMPERATURE = np.array([name.endswith("_k") for name in BETWEEN_PACKS])


def between_packs(signal: str) -> pl.Expr:
    """Return how far pack 1's mean of a signal lies above pack 2's."""
    first, second = (pl.col(signal).filter(pl.col("pack") == number).mean() for number in PACKS)
    return first - second


def exchanged_packs(flights: pl.DataFrame) -> pl.DataFrame:
    """Select the flights that were recorded with the packs exchanged.

    Parameters
    ----------
    flights : DataFrame
        `FLIGHT`, `departed_at` and the columns of `BETWEEN_PACKS`, without flights that are held for other reasons.

    Returns
    -------
    DataFrame
        `FLIGHT`, `reason`.
    """
    ordered = flights.sort(*AIRCRAFT, "departed_at", "flight_id")
    sd = {name: flight_to_flight_sd(name) for name in BETWEEN_PACKS}
    standardised = ordered.select(*FLIGHT, *(pl.col(n) / pl.when(s > 0.0).then(s) for n, s in sd.items()))
    suspects = standardised.filter(pl.Series(_find_changes(standardised)))
    aircraft = suspects.select(AIRCRAFT).unique(maintain_order=True).iter_rows(named=True)
    held_flights = [_flights_of_exchange(standardised.filter(**own)) for own in aircraft]
    return pl.concat([standardised.clear(), *held_flights]).select(*FLIGHT, reason=pl.lit(EXCHANGED))


def _find_changes(flights: pl.DataFrame) -> Array:
    """Return whether the packs change places at each flight, by all that distinguishes them."""
    return are_reversed(*_before_and_after(flights))


def _before_and_after(flights: pl.DataFrame) -> tuple[Array, Array]:
    """Return how the packs typically differ before each flight and from it on."""
    names = list(BETWEEN_PACKS)
    earlier = pl.col(names).rolling_median(MOST_FLIGHTS, min_samples=LEAST_FLIGHTS).shift().over(AIRCRAFT)
    later = pl.col(names).reverse().rolling_median(AFTER, min_samples=AFTER).reverse().over(AIRCRAFT)
    return flights.select(earlier).to_numpy(), flights.select(later).to_numpy()


def flight_to_flight_sd(name: str, of: Sequence[str] = AIRCRAFT) -> pl.Expr:
    """Return the standard deviation of a difference between flights in a row of an aircraft, without its drift."""
    step = pl.col(name).diff().abs().over(AIRCRAFT)
    return step.median().over(of) * (MAD_TO_SD / sqrt(2.0))


def are_reversed(before: Array, after: Array, share: float = 1.0) -> Array:
    """Return whether what distinguishes two packs changed sign and kept its size.

    Parameters
    ----------
    before, after : array
        (n, signals). Typical differences of the packs before and after, in standard deviations from flight to flight;
        NaN where not recorded.
    share : float
        Share of the clear differences that must have changed sign.

    Returns
    -------
    array
        (n,), bool.
    """
    is_clear = (np.abs(before) > CLEAR) & np.isfinite(after)
    ratio = np.divide(after, before, out=np.full_like(before, np.nan), where=is_clear)
    n_clear = is_clear.sum(axis=1)
    is_reversed = (is_clear & (ratio < REVERSED)).sum(axis=1) >= share * n_clear
    evidence = AFTER * np.where(is_clear, before**2, 0.0).sum(axis=1)
    has_both_kinds = is_clear[:, _IS_TEMPERATURE].any(axis=1) & is_clear[:, ~_IS_TEMPERATURE].any(axis=1)
    candidates = is_reversed & has_both_kinds & (n_clear >= LEAST_CLEAR) & (evidence > LEAST_EVIDENCE)
    median = np.full(len(before), np.nan)
    median[candidates] = np.nanmedian(ratio[candidates], axis=1)
    near: Array = np.abs(median + 1.0) < MEDIAN_TOLERANCE
    return near


def _flights_of_exchange(flights: pl.DataFrame) -> pl.DataFrame:
    """Select an aircraft's flights between each change and the next, which takes it back.

    That it has one is known. So not all that distinguishes the packs must change sign: a sensor or unit may have been
    changed on the same flight.
    """
    as_before = flights
    changes = [0]
    while len(changes) <= MAX_CHANGES:
        before, after = _before_and_after(as_before)
        usual = np.where(np.abs(before) > CLEAR, before, 0.0)
        is_exchanged = len(changes) % 2 == 0
        is_change = are_reversed(before, after, TO_END if is_exchanged else TO_BEGIN)
        further = np.flatnonzero(is_change & (np.arange(flights.height) > changes[-1]))
        if not further.size:
            break
        values = as_before.select(BETWEEN_PACKS.keys()).to_numpy()[further[0] :]
        is_other = np.nansum(values[:AFTER] * usual[further[0]], axis=1) < 0.0
        changes.append(int(further[0] + np.argmax(is_other)))
        is_later = pl.int_range(pl.len()) >= changes[-1]
        as_before = as_before.with_columns(
            pl.when(is_later).then(-pl.col(n)).otherwise(n).alias(n) for n in BETWEEN_PACKS
        )
    n_changes = np.searchsorted(changes[1:], np.arange(flights.height), side="right")
    return flights.filter(pl.Series(n_changes % 2 == 1))
