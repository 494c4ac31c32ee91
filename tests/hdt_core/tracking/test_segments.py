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
from hdt_core.tracking.track import track

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


def test_a_flight_that_came_late_changes_what_follows_it(three, log, model, whole):
    without = three.filter(~((pl.col("tail") == "S-0") & pl.col("flight_id").is_in([three["flight_id"][222]])))
    assert without.height == three.height - 1
    assert same(track(three, log, model, track(without, log, model)), whole)


def test_an_entry_that_came_late_counts(three, log, model, whole):
    before = track(three, NO_LOG, model)
    assert not same(before, whole)
    assert same(track(three, log, model, before), whole)


def test_who_flies_beside_does_not_matter(three, log, model, whole):
    for (tail,), own in three.group_by("tail"):
        alone = track(own, log, model)
        assert alone.health.equals(whole.health.filter(tail=tail))
        assert alone.checkpoints.equals(whole.checkpoints.filter(tail=tail))


def test_the_literal_recursion_says_the_same_to_the_last_digit(three, log, model):
    batched = fouling(three, log, model).filter(parameter="hx_fouling")
    assert batched.equals(fouling(three, log, model, literal=True))


def test_only_the_last_segments_are_filtered_again(three, log, model, whole, monkeypatch):
    flown, step = [], segments.step
    monkeypatch.setattr(
        segments, "step", lambda b, observation, s: flown.append(len(observation.ratio)) or step(b, observation, s)
    )
    assert same(track(three, log, model, whole), whole)
    assert sum(flown) == 3 * (
        (430 - 350) + (330 - 250) + (150 - 50)
    )  # of the exchanger and the compressor's two losses


def test_a_smoothed_value_is_final_once_the_next_segment_is_flown(three, log, model, whole):
    end = three.filter(tail="S-0")["departed_at"][3 * segments.SEGMENT_FLIGHTS - 1]
    early = track(three.filter(pl.col("departed_at") <= end), log, model)
    settled = three.filter(tail="S-0").head(2 * segments.SEGMENT_FLIGHTS)["flight_id"].implode()
    then, now = (
        t.health.filter(pl.col("flight_id").is_in(settled), parameter="hx_fouling_smoothed") for t in (early, whole)
    )
    assert then.height == 2 * segments.SEGMENT_FLIGHTS
    assert then.equals(now)


def test_nothing_is_gone_on_from_that_is_not_as_it_was(three, log, model, whole):
    """Another code, rows lost, checkpoints lost: the filter begins where it must."""
    other = track(three, log, model, whole._replace(health=whole.health.with_columns(value=0.0)), seal="2")
    assert other.health.equals(whole.health)
    incomplete = whole._replace(health=whole.health.filter(pl.col("flight_id") != whole.health["flight_id"][40]))
    assert same(track(three, log, model, incomplete), whole)
    torn = whole._replace(checkpoints=whole.checkpoints.filter(pl.col("chapter") != 2))
    assert track(three, log, model, torn).health.equals(whole.health)
