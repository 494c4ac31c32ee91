"""What is found of each aircraft by itself, for a whole fleet."""

from collections.abc import Callable

import polars as pl

AIRCRAFT = ["operator", "tail"]


def of_each_aircraft(samples: pl.DataFrame, find: Callable[[pl.DataFrame], pl.DataFrame]) -> pl.DataFrame:
    """`find` asked of one aircraft's samples after the other, what it says of each one beneath the other's.

    The same as asked of all at once where it looks at no other aircraft, and the steps on the way there take the memory
    of one aircraft instead of the fleet's.

    Examples
    --------
    >>> rows = pl.DataFrame({"operator": ["A", "A", "B"], "tail": ["A1", "A1", "B1"], "x": [1, 3, 7]})
    >>> of_each_aircraft(rows, lambda own: own.group_by("tail").agg(pl.col("x").sum())).rows()
    [('A1', 4), ('B1', 7)]
    """
    own = samples.group_by(AIRCRAFT, maintain_order=True)
    return pl.concat([find(samples.clear()), *(find(part) for _, part in own)])
