"""Find whether one delivery of a flight is another one at other times."""

import numpy as np
import polars as pl
from numpy.typing import NDArray

from pipelines.intake.columns import SIGNAL_COLUMNS, Column

MIN_COPIES = 5
"""Least reports that are found again, one after the other."""
COPIED_SHARE = 0.8
"""Least share of the reports that are found again."""
MIN_SHARED = 4
"""Least signals that two reports must both have to be one."""
MAX_COMPARED = 200
"""Most reports of a pack that are looked for, spread evenly; a flight has 20 to 60."""
STEPS = (1.0, 0.1, 0.01, 0.001)
"""Steps in recorded units to which numbers may be rounded."""
SAME = 1e-6
"""Relative difference up to which two values are the same: a 32-bit float and the text it was printed from."""


def repeats(rows: pl.DataFrame, others: pl.DataFrame) -> bool:
    """Return whether rows of one flight are those of `others` at other times.

    Most of the rows must read like rows of the other delivery, signal by signal to the coarser rounding of the two, and
    in the same order. Of rows that read alike only the first counts: a constant record proves nothing.

    Parameters
    ----------
    rows, others : DataFrame
        Rows of the same flight in SI; none has the pack and time of one of the others.
    """
    n_compared = 0
    n_copies = 0
    of_packs = others.partition_by("pack", as_dict=True)
    for pack, own in rows.partition_by("pack", as_dict=True).items():
        if pack in of_packs:
            partners = _find_partners(own.sort("time_utc"), of_packs[pack].sort("time_utc"))
            advance = np.diff(partners[partners >= 0], prepend=-1)
            n_compared += int(len(partners) - np.sum(advance == 0))
            n_copies += int(np.sum(advance > 0))
    return n_copies >= max(MIN_COPIES, COPIED_SHARE * n_compared)


def _find_partners(own: pl.DataFrame, others: pl.DataFrame) -> NDArray[np.int64]:
    """Find for each row the first of the others that reads like it; -1 where none does."""
    compared = own.gather_every(-(-own.height // MAX_COMPARED))
    alike = np.ones((compared.height, others.height), dtype=bool)
    n_shared = np.zeros(alike.shape, dtype=np.int64)
    for column in SIGNAL_COLUMNS:
        value = compared[column.si_name].to_numpy()
        other = others[column.si_name].to_numpy()
        rounding = max(_rounding(value, column), _rounding(other, column))
        difference = np.abs(value[:, None] - other)
        alike &= ~(difference > 1.001 * rounding + SAME * np.abs(other))
        n_shared += ~np.isnan(difference)
    alike &= n_shared >= MIN_SHARED
    return np.where(alike.any(axis=1), alike.argmax(axis=1), -1)


def _rounding(values: NDArray[np.float64], column: Column) -> float:
    """Return the most by which rounding changed the values; 0 where they are not rounded."""
    recorded = (values - column.offset) / column.scale
    for step in STEPS:
        in_steps = recorded / step
        if not np.any(np.abs(in_steps - np.round(in_steps)) > 1e-3):
            return step * column.scale / 2.0
    return 0.0
