"""The methods' comparison on one aircraft's compressor: by name, alone, and as the chain does it."""

import numpy as np

from benchmarks.methods import CALIBRATED_ON, SIZE, aircraft, chain, follow, packs
from benchmarks.promise import unpolished
from hdt_core.components.pack import CC
from hdt_core.estimation import estimators


def test_methods_follow_same_flights_as_chain():
    plane = aircraft(102)
    parts = list(packs(plane))
    number = next(k for k, pack in enumerate(parts) if pack.component is CC)
    results = [follow(method, parts[number]) for method in (estimators()["nls"], unpolished(estimators()["pso"]))]
    for result in (*results, chain(plane)[number]):
        assert 1 < len(result.loss) <= SIZE.flights - CALIBRATED_ON
        assert np.abs(result.error).max() < 4.0 * result.sd.max()
