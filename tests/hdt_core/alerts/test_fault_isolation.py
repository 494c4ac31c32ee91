"""Medians of late flights, of which a channel may have measured any number; records that end while one doubts."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.alerts.fault_isolation import MEDIAN_WORTH, Indications, _median_z
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.signatures import CHANNELS
from hdt_core.health.detection import watch


@pytest.mark.parametrize("flights", [0, 1, 2, 5, 12])
def test_medians_of_what_was_measured_are_numpys(flights):
    rng = np.random.default_rng(flights)
    z = rng.standard_normal((flights, 40))
    z[rng.random(z.shape) < 0.4] = np.nan
    z[rng.random(z.shape) < 0.2] = 0.0  # a spike that was taken out
    middle, worth = _median_z(z)
    for k, column in enumerate(z.T):
        seen = column[np.isfinite(column) & (column != 0.0)]
        assert worth[k] == (max(seen.size, 1e-9) if seen.size < 3 else MEDIAN_WORTH * seen.size)
        assert np.isnan(middle[k]) if not seen.size else middle[k] == np.median(seen) * np.sqrt(worth[k])


def test_a_doubt_that_outlasts_the_record_is_left_open() -> None:
    """The last aircraft has the shorter record: what the grid holds beyond it is padding and no flight."""
    flown = [(tail, f, p) for tail, flights in (("T-1", 60), ("T-2", 30)) for f in range(flights) for p in (1, 2)]
    rows = pl.DataFrame(flown, schema=["tail", "flight", "pack"], orient="row").with_columns(
        pl.col("pack").cast(pl.Int32),
        operator=pl.lit("TST"),
        flight_id=pl.col("tail") + pl.col("flight").cast(pl.String),
        departed_at=datetime(2024, 1, 1, tzinfo=UTC) + pl.col("flight") * timedelta(hours=6),
    )
    grid = Grid.cut(rows)
    still = np.where(grid.flown[:, :, None], np.zeros(len(CHANNELS)), np.nan)
    shift = watch(still, np.array([c.sd for c in CHANNELS]), np.zeros(still.shape, dtype=bool))
    evidence = Indications(grid, shift, np.zeros(grid.shape), grid.partner())
    assert [evidence.name(0, (unit, 25, None)) for unit in range(4)] == [None] * 4
    assert evidence.name(0, (3, 25, 40)) is None
