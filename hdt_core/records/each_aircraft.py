"""Apply a function to each aircraft of a fleet."""

from collections.abc import Callable

import polars as pl

AIRCRAFT = ["operator", "tail"]


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
