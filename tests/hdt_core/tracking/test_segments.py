"""Going on from a checkpoint ends where one pass over all flights ends, to the last digit."""

from datetime import timedelta

import numpy as np
import polars as pl
import pytest
from literal_track import fouling
from twin_flights import NO_LOG, entry, flights_with_loss

from hdt_core.tables.twin import TwinFlights
from hdt_core.tracking import segments
from hdt_core.tracking.loss_filter import TrackResult
from hdt_core.tracking.multiple_model_filter import start
from hdt_core.tracking.segments import FlightPanel, SegmentResult, _merge_branches, filter_segments
from hdt_core.tracking.track import track
from hdt_core.tracking.wear_model import Observation, Settings

N = 430
WEAR = np.r_[np.linspace(0.0, 0.25, 170), np.linspace(0.0, 0.1, 120), np.full(140, 0.3)]


@pytest.fixture(scope="module")
def three(model) -> pl.DataFrame:
    """Three packs, of 430, 330 and 150 flights."""
    parts = [flights_with_loss(model, WEAR, seed=k, tail=f"S-{k}").head(N - n) for k, n in enumerate((0, 100, 280))]
    flights = TwinFlights.conform(pl.concat(parts))
    compressor = {"cc_n_samples": pl.lit(9, pl.Int32), "expected_diameter_m": pl.lit(0.17)}
    for name, built, share in (("efficiency", model.compressor.efficiency, 0.1), ("diameter_m", 0.17, 0.05)):
        compressor[name] = built * (share * pl.col("ln_ua_ratio")).exp()
    return flights.with_columns(**compressor)


@pytest.fixture(scope="module")
def log(three) -> pl.DataFrame:
    return entry(three.filter(tail="S-0"), 170, "HX", "REPLACED")


@pytest.fixture(scope="module")
def whole(three, log, model) -> TrackResult:
    return track(three, log, model)


def same(one: TrackResult, other: TrackResult) -> bool:
    return one.health.equals(other.health) and one.checkpoints.equals(other.checkpoints)


@pytest.mark.parametrize("days", [1, 20, 36, 80, 200])
def test_nights_add_up_to_one_pass(three, log, model, whole, days):
    end = three["departed_at"].max()
    early = track(three.filter(pl.col("departed_at") < end - timedelta(days=days)), log, model)
    assert same(track(three, log, model, early), whole)


def test_late_flight_changes_later_ones(three, log, model, whole):
    without = three.filter(~((pl.col("tail") == "S-0") & pl.col("flight_id").is_in([three["flight_id"][222]])))
    assert without.height == three.height - 1
    assert same(track(three, log, model, track(without, log, model)), whole)


@pytest.mark.parametrize("tail", ["S-0", "S-1", "S-2"])
def test_pack_is_tracked_as_alone(three, log, model, whole, tail):
    alone = track(three.filter(tail=tail), log, model)
    assert alone.health.equals(whole.health.filter(tail=tail))
    assert alone.checkpoints.equals(whole.checkpoints.filter(tail=tail))


def test_late_entry_counts(three, log, model, whole):
    before = track(three, NO_LOG, model)
    assert not same(before, whole)
    assert same(track(three, log, model, before), whole)


def test_segments_equal_literal_recursion(three, log, model):
    batched = fouling(three, log, model).filter(parameter="hx_fouling")
    assert batched.equals(fouling(three, log, model, literal=True))


def test_only_last_segments_are_refiltered(three, log, model, whole, monkeypatch):
    flown = []
    step = segments.step
    monkeypatch.setattr(
        segments, "step", lambda b, observation, s: flown.append(len(observation.ratio)) or step(b, observation, s)
    )
    assert same(track(three, log, model, whole), whole)
    assert sum(flown) == 3 * (
        (430 - 350) + (330 - 250) + (150 - 50)
    )  # of the exchanger and the compressor's two losses


def test_smoothed_value_becomes_final(three, log, model, whole):
    """Once the next segment is flown."""
    end = three.filter(tail="S-0")["departed_at"][3 * segments.SEGMENT_FLIGHTS - 1]
    early = track(three.filter(pl.col("departed_at") <= end), log, model)
    settled = three.filter(tail="S-0").head(2 * segments.SEGMENT_FLIGHTS)["flight_id"].implode()
    settled_rows = pl.col("flight_id").is_in(settled)
    then, now = (t.health.filter(settled_rows, parameter="hx_fouling_smoothed") for t in (early, whole))
    assert then.height == 2 * segments.SEGMENT_FLIGHTS
    assert then.equals(now)


def test_other_code_discards_checkpoints(three, log, model, whole):
    other = track(three, log, model, whole._replace(health=whole.health.with_columns(value=0.0)), seal="2")
    assert other.health.equals(whole.health)


def test_lost_rows_discard_checkpoints(three, log, model, whole):
    incomplete = whole._replace(health=whole.health.filter(pl.col("flight_id") != whole.health["flight_id"][40]))
    assert same(track(three, log, model, incomplete), whole)


def test_lost_checkpoints_are_filtered_anew(three, log, model, whole):
    torn = whole._replace(checkpoints=whole.checkpoints.filter(pl.col("chapter") != 2))
    assert track(three, log, model, torn).health.equals(whole.health)


SETTINGS = Settings(0.0, 0.01, 0.05)
NONE = np.zeros(2, dtype=np.int64)


def panel(first: np.ndarray, second: np.ndarray) -> FlightPanel:
    """Two packs side by side, the second with fewer flights; rows are numbered pack by pack."""
    n = len(first)
    m = len(second)
    row = np.column_stack([np.arange(n), np.where(np.arange(n) < m, n + np.arange(n), -1)])
    ratio = np.column_stack([first, np.r_[second, np.full(n - m, np.nan)]])
    flat = np.zeros((n, 2))
    return FlightPanel(row, Observation(ratio, flat + 4e-4, flat + 1.0, flat, flat, flat, flat + 1.0))


@pytest.fixture(scope="module")
def ratios() -> tuple[np.ndarray, np.ndarray]:
    """Of two packs."""
    rng = np.random.default_rng(1)
    first, second = (0.01 * rng.standard_normal(n) - 0.001 * np.arange(n) for n in (112, 56))
    return first, second


@pytest.fixture(scope="module")
def single_pass(ratios) -> SegmentResult:
    """Filtered in one pass."""
    return filter_segments(panel(*ratios), SETTINGS, NONE, {})


def test_every_flight_is_smoothed(single_pass):
    assert single_pass.tracks.shape == (4, 168)
    assert np.isfinite(single_pass.tracks).all()
    np.testing.assert_allclose(
        single_pass.tracks[2:, [111, 167]], single_pass.tracks[:2, [111, 167]]
    )  # nothing follows the last


@pytest.mark.parametrize(("changed", "first_known"), [(99, 0), (100, 50)])
def test_smoothing_looks_one_segment_ahead(ratios, single_pass, changed, first_known):
    first, second = ratios
    other = first + 0.05 * (np.arange(112) == changed)
    is_other = filter_segments(panel(other, second), SETTINGS, NONE, {}).tracks != single_pass.tracks
    assert np.flatnonzero(is_other[:2].any(axis=0)).tolist() == list(range(changed, 112))
    smoothed = np.flatnonzero(is_other[2:].any(axis=0))
    assert (smoothed.min(), smoothed.max()) == (first_known, 111)


def test_pass_leaves_checkpoints(single_pass):
    assert sorted(single_pass.checkpoints) == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)]


@pytest.mark.parametrize("segment", [1, 2])
def test_checkpoint_continues_the_pass(ratios, single_pass, segment):
    """Beside a pack that begins anew, which may have the more flights to come."""
    later = filter_segments(panel(*ratios), SETTINGS, np.array([segment, 0]), single_pass.checkpoints).tracks
    assert np.isnan(later[:, : 50 * segment]).all()
    np.testing.assert_allclose(later[:, 50 * segment :], single_pass.tracks[:, 50 * segment :], rtol=1e-12)


def test_sibling_branches_merge_by_moments():
    before = start(SETTINGS)
    parent = np.array([3, 3, 5])
    weight = np.array([0.2, 0.6, 0.1])
    mean = np.zeros((3, 5))
    cov = np.tile(1e-9 * np.eye(5), (3, 1, 1))
    mean[:, 0] = 0.1, 0.2, 0.3
    after = _merge_branches(before, parent, weight, mean, cov)
    np.testing.assert_allclose(np.exp(after.log_weight[[3, 5]]), [0.8, 0.1])
    assert np.exp(np.delete(after.log_weight, [3, 5])).max() < 1e-200
    np.testing.assert_allclose(after.mean[[3, 5], 0], [0.175, 0.3])
    # of one hypothesis a hundredth of a per cent is left at the least
    np.testing.assert_allclose(after.cov[[3, 5], 0, 0], [0.25 * 0.075**2 + 0.75 * 0.025**2 + 1e-9, 1e-8])
    np.testing.assert_allclose(after.cov[5, 1, 1], 1e-9)
