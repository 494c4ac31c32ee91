"""The signature matrix names what moved, and says so when it can't know."""

import numpy as np
import pytest

from hdt_core.health.diagnosis import CHANNELS, classify, signatures

NAMES, MATRIX = signatures()
TELLING = range(len(NAMES))


@pytest.mark.parametrize("k", TELLING, ids=lambda k: "-".join(NAMES[k]))
@pytest.mark.parametrize("size", [-12.0, 12.0])
def test_names_the_sensor_and_the_pack(k: int, size: float) -> None:
    rng = np.random.default_rng(k)
    hits = [classify(size * MATRIX[k] + rng.standard_normal(MATRIX.shape[1]))[0][:2] == NAMES[k] for _ in range(20)]
    assert np.mean(hits) >= 0.8


def test_does_not_name_what_it_cannot_know() -> None:
    # left against right alone can't tell whose outlet it is
    z = np.full(MATRIX.shape[1], np.nan)
    z[[c.name for c in CHANNELS].index("hx_out_between_packs_k")] = 9.0
    assert classify(z)[0][2] == pytest.approx(0.5, abs=0.01)


def test_probabilities_add_up_with_channels_missing() -> None:
    z = 5.0 * MATRIX[0]
    z[3:] = np.nan
    assert sum(p for _, _, p in classify(z)) == pytest.approx(1.0)


def test_a_real_step_of_the_exchanger_is_no_sensor() -> None:
    z = np.zeros(2 * (len(CHANNELS) + 1))
    z[len(CHANNELS)] = 8.0
    assert classify(z)[0][:2] == ("hx", "own")
