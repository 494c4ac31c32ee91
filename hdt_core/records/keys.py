"""Columns that name what a row is about, in the order in which tables are sorted by them, and queries by them."""

from collections.abc import Callable, Sequence

import numpy as np
import polars as pl
from numpy.typing import NDArray

AIRCRAFT = ["operator", "tail"]
FLIGHT = [*AIRCRAFT, "flight_id"]
PACK = [*AIRCRAFT, "pack"]
FLIGHT_PACK = [*PACK, "flight_id"]
IN_ORDER = [*PACK, "departed_at", "flight_id"]
"""Flights of a pack as flown; the id settles what departs at one instant in a made-up file."""
LEG = [*FLIGHT, "pack"]
LEG_AT = [*LEG, "departed_at"]


def of_each_aircraft(samples: pl.DataFrame, function: Callable[[pl.DataFrame], pl.DataFrame]) -> pl.DataFrame:
    """Apply `function` to each aircraft's samples and concatenate the results.

    Equal to one call where rows of other aircraft do not matter, with the memory of one aircraft instead of the fleet.

    Examples
    --------
    >>> rows = pl.DataFrame({"operator": ["A", "A", "B"], "tail": ["A1", "A1", "B1"], "x": [1, 3, 7]})
    >>> of_each_aircraft(rows, lambda own: own.group_by("tail").agg(pl.col("x").sum())).rows()
    [('A1', 4), ('B1', 7)]
    """
    parts = samples.group_by(AIRCRAFT, maintain_order=True)
    return pl.concat([function(samples.clear()), *(function(part) for _, part in parts)])


def is_among(keys: pl.DataFrame) -> pl.Expr:
    """Whether a row's values in the columns of `keys` are those of one of its rows."""
    return pl.struct(keys.columns).is_in(keys.to_struct().implode())


def number_packs(rows: pl.DataFrame) -> NDArray[np.int64]:
    """Number the packs from 0, by operator, tail and pack. (n,)"""
    return rows.select(pl.struct(PACK).rank("dense").cast(pl.Int64) - 1)[:, 0].to_numpy()


def split_packs(rows: pl.DataFrame) -> list[NDArray[np.int64]]:
    """Return the row numbers of each pack; rows of a pack stand together."""
    return np.split(np.arange(rows.height), np.flatnonzero(np.diff(number_packs(rows))) + 1)


def join_other_pack(rows: pl.DataFrame, columns: Sequence[str], more_keys: Sequence[str] = ()) -> pl.DataFrame:
    """Add columns of the same flight's other pack as `other_<column>`; `more_keys` also name a row, beside its leg."""
    key = [*FLIGHT, *more_keys]
    number = (3 - pl.col("pack")).cast(rows.schema["pack"])
    other = rows.select(*key, number.alias("pack"), pl.col(columns).name.prefix("other_"))
    return rows.join(other, on=[*key, "pack"], how="left", maintain_order="left", validate="m:1")
