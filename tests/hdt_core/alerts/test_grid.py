"""The fleet as arrays: what the other pack says stands where its flight does."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl

from hdt_core.alerts.grid import Grid


def test_across_gives_the_other_packs_values_on_the_same_flight() -> None:
    flown = [("F1", 1, 1.0), ("F1", 2, 2.0), ("F2", 1, 3.0), ("F3", 1, 5.0), ("F3", 2, 6.0)]
    rows = pl.DataFrame(flown, schema=["flight_id", "pack", "x"], orient="row").with_columns(
        pl.col("pack").cast(pl.Int32),
        departed_at=pl.Series([datetime(2024, 1, 1, tzinfo=UTC) + timedelta(days=int(f[1])) for f, *_ in flown]),
        operator=pl.lit("TST"),
        tail=pl.lit("T-1"),
    )
    grid = Grid.from_frame(rows)
    np.testing.assert_array_equal(grid.across(grid.values("x")), [[2.0, np.nan, 6.0], [1.0, 5.0, np.nan]])
    assert grid.across(grid.values("x") > 2.0).tolist() == [[False, False, True], [False, True, False]]
    one = Grid.from_frame(rows.head(1))
    assert (one.shape, one.is_flight.tolist(), one.partner().tolist()) == ((1, 1), [[True]], [-1])
    assert Grid.from_frame(rows.clear()).shape == (0, 0)
    assert (grid.partner().tolist(), grid.count(0), grid.count(1)) == ([1, 0], 3, 2)
