"""What physics refuses is not always another unit or another place."""

import numpy as np
import polars as pl
import pytest

from pipelines.intake.columns import SIGNAL_NAMES
from pipelines.intake.unit_slips import find_unit_slips

OFF = {"tat_degc": -20.0, "hx_in_degc": -19.0, "hx_out_degc": -19.5, "altitude_ft": 35e3}
"""A pack that is off shows outside air at every station."""
SWAPPED = {"tat_degc": -20.0, "hx_in_degc": 30.0, "hx_out_degc": 15.0, "ram_out_degc": 110.0, "altitude_ft": 35e3}


@pytest.mark.parametrize(("near", "told"), [(OFF, []), (SWAPPED, ["swapped_columns"])])
def test_columns_change_places_only_where_both_are_recorded(near, told):
    """A pack that is off says nothing of a sensor that nobody fitted."""
    rng, n = np.random.default_rng(0), 60
    read = {c: near[c] + rng.normal(0.0, 0.4, n) if c in near else pl.Series([None] * n, dtype=pl.Float64)
            for c in SIGNAL_NAMES}  # fmt: skip
    rows = pl.DataFrame({"file_index": [0] * n, "flight_id": ["T_20240101_01"] * n, "pack": [1] * n, **read})
    assert find_unit_slips(rows)["reason"].unique().to_list() == told


@pytest.mark.parametrize("far", [1.7e308, -1.7e308, 1e200, -1e155, np.inf])
def test_a_number_far_from_any_reading_overflows_nothing(far):
    """Warnings are errors here: NumPy would say so in the middle of a night."""
    rng, n = np.random.default_rng(0), 60
    read = {c: rng.normal(SWAPPED.get(c, 50.0), 0.4, n) for c in SIGNAL_NAMES}
    for name in SIGNAL_NAMES:
        read[name][7] = far
    rows = pl.DataFrame({"file_index": [0] * n, "flight_id": ["T_20240101_01"] * n, "pack": [1] * n, **read})
    assert find_unit_slips(rows).height <= n
