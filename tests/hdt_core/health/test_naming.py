"""Medians of late flights, of which a channel may have measured any number."""

import numpy as np
import pytest

from hdt_core.health.naming import MEDIAN_WORTH, _median_z


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
