"""Segments of fifty flights: what a smoothed value knows, where checkpoints stand, what a branch leaves its parent."""

import numpy as np
import pytest

from hdt_core.tracking.flight_panel import FlightPanel
from hdt_core.tracking.hypotheses import start
from hdt_core.tracking.segments import _merge_branches, filter_segments
from hdt_core.tracking.wear_model import Observation, Settings

SETTINGS = Settings(0.0, 0.01, 0.05)
NONE = np.zeros(2, dtype=np.int64)


def panel(first: np.ndarray, second: np.ndarray) -> FlightPanel:
    """Two packs side by side, the second with fewer flights; rows are numbered pack by pack."""
    n, m = len(first), len(second)
    row = np.column_stack([np.arange(n), np.where(np.arange(n) < m, n + np.arange(n), -1)])
    ratio = np.column_stack([first, np.r_[second, np.full(n - m, np.nan)]])
    flat = np.zeros((n, 2))
    return FlightPanel(row, Observation(ratio, flat + 4e-4, flat + 1.0, flat, flat, flat, flat + 1.0))


@pytest.fixture(scope="module")
def flown() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(1)
    first, second = (0.01 * rng.standard_normal(n) - 0.001 * np.arange(n) for n in (112, 56))
    return first, second, filter_segments(panel(first, second), SETTINGS, NONE, {}).tracks


def test_a_smoothed_value_knows_the_end_of_the_next_segment_and_no_more(flown):
    first, second, tracks = flown
    assert tracks.shape == (4, 168)
    assert np.isfinite(tracks).all()
    for changed, from_flight in ((99, 50), (100, 100)):  # flight 99 is known from 0 on, flight 100 from 50 on
        other = first.copy()
        other[changed] += 0.05
        changed_tracks = filter_segments(panel(other, second), SETTINGS, NONE, {}).tracks
        assert np.flatnonzero(np.any(changed_tracks[:2] != tracks[:2], axis=0)).tolist() == list(range(changed, 112))
        smoothed = np.flatnonzero(np.any(changed_tracks[2:] != tracks[2:], axis=0))
        assert smoothed.min() == (0 if from_flight == 50 else 50)
        assert smoothed.max() == 111
    np.testing.assert_allclose(tracks[2:, [111, 167]], tracks[:2, [111, 167]])  # nothing follows the last


@pytest.mark.parametrize("segment", [1, 2])
def test_a_night_goes_on_from_a_checkpoint(flown, segment):
    """Beside a pack that begins anew, which may have the more flights to come."""
    first, second, tracks = flown
    whole = filter_segments(panel(first, second), SETTINGS, NONE, {})
    assert sorted(whole.checkpoints) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)]
    begin = np.array([segment, 0])
    later = filter_segments(panel(first, second), SETTINGS, begin, whole.checkpoints).tracks
    assert np.isnan(later[:, : 50 * segment]).all()
    np.testing.assert_allclose(later[:, 50 * segment :], tracks[:, 50 * segment :], rtol=1e-12)


def test_branches_of_one_parent_are_merged_by_their_moments():
    before = start(SETTINGS)
    parent, weight = np.array([3, 3, 5]), np.array([0.2, 0.6, 0.1])
    mean, cov = np.zeros((3, 5)), np.tile(1e-9 * np.eye(5), (3, 1, 1))
    mean[:, 0] = 0.1, 0.2, 0.3
    after = _merge_branches(before, parent, weight, mean, cov)
    np.testing.assert_allclose(np.exp(after.log_weight[[3, 5]]), [0.8, 0.1])
    assert np.exp(np.delete(after.log_weight, [3, 5])).max() < 1e-200
    np.testing.assert_allclose(after.mean[[3, 5], 0], [0.175, 0.3])
    # of one hypothesis a hundredth of a per cent is left at the least
    np.testing.assert_allclose(after.cov[[3, 5], 0, 0], [0.25 * 0.075**2 + 0.75 * 0.025**2 + 1e-9, 1e-8])
    np.testing.assert_allclose(after.cov[5, 1, 1], 1e-9)
