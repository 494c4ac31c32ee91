"""Prognoses of a month come from what was on record when it began, whenever the record came."""

from dataclasses import replace
from datetime import UTC, date, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.prognosis.feature_rows import PRIOR_RULES, fleet_rows, learn_rule, tracks, tracks_as_of
from hdt_core.prognosis.fleet_record import FleetRecord, start_of
from hdt_core.prognosis.model import fit_component
from hdt_core.prognosis.service import update_model
from pipelines.learned import shipped_base

IN_MARCH = datetime(2024, 3, 30, tzinfo=UTC)
NUMBERS = ["rul_flights", "rul_low", "rul_high", *(f"p_event_{k}" for k in (25, 50, 100, 200, 300))]
KEY = ["component", "operator", "tail", "pack", "departed_at", "flight_id"]


@pytest.fixture(scope="module")
def base():
    return shipped_base()


@pytest.fixture(scope="module")
def at_once(fleet, base):
    return update_model(base, None, FleetRecord(*fleet))


def same(one: pl.DataFrame, other: pl.DataFrame) -> None:
    """Row for row, to 1e-9."""
    assert one.drop(NUMBERS).equals(other.drop(NUMBERS))
    np.testing.assert_allclose(one[NUMBERS].to_numpy(), other[NUMBERS].to_numpy(), atol=1e-9)


def test_monthly_updates_equal_one_update(fleet, base, at_once):
    """Each row as it stood at the end of its month, and none rewritten since."""
    whole = FleetRecord(*fleet)
    last = None
    months = whole.months()
    assert len(months) > 3
    for month, end in zip(months, [*months[1:], None], strict=True):
        last = update_model(base, last, whole.as_of(start_of(end)) if end else whole)
        flown = pl.col("departed_at") >= start_of(month)
        same(
            last.prognoses.filter(flown),
            at_once.prognoses.filter(flown, pl.col("departed_at") <= last.prognoses["departed_at"].max()),
        )
    same(last.prognoses, at_once.prognoses)
    assert last.months.keys() == at_once.months.keys()
    for month, own in at_once.months.items():
        assert replace(last.months[month], model=own.model) == own
        assert last.months[month].model.version == own.model.version
    assert at_once.prognoses["model_version"].n_unique() == len({m.model.version for m in at_once.months.values()}) > 2


def test_later_records_change_no_prognosis(fleet, at_once, base):
    """Whatever becomes of the units after February: none fails, or all are worn."""
    whole = FleetRecord(*fleet)
    end = datetime(2024, 3, 1, tzinfo=UTC)
    later = pl.col("departed_at") >= end
    quiet = replace(whole, messages=whole.messages.filter(pl.col("message_time") < end))
    worn = whole.features.with_columns(pl.when(later).then(0.4).otherwise("hx_fouling").alias("hx_fouling"))
    for other in (quiet, replace(whole, features=worn)):
        now = update_model(base, None, other).prognoses
        same(now.filter(~later), at_once.prognoses.filter(~later))
        assert not now.filter(later).equals(at_once.prognoses.filter(later))


def test_first_month_uses_base_alone(at_once, base):
    first = at_once.months[min(at_once.months)].model
    assert first.fits["HX"].failures == 0
    assert first.fits["HX"].levels == base.base_levels
    assert not any(first.fits["HX"].correction.weights)
    assert at_once.newest.model.fits["HX"].failures > 5


@pytest.mark.parametrize("component", ["HX", "CC"])
def test_month_learns_from_truncated_record(fleet, component):
    """Rows are cut once from the whole record: they equal those of a record that ends there, and so do lives."""
    whole = FleetRecord(*fleet)
    moment = datetime(2024, 3, 1, tzinfo=UTC)
    past = whole.as_of(moment)
    alone = tracks(past.features, past.lives(), component)
    cut = tracks_as_of(tracks(whole.features, whole.lives(), component), moment, past.lives(), component)
    flown = (cut.keys["departed_at"] < moment).to_numpy()
    assert cut.mute[~flown].all()
    for name in ("remaining", "failed", "mute"):
        np.testing.assert_array_equal(getattr(cut, name)[flown], getattr(alone, name))
    rule = PRIOR_RULES[component]
    one = fleet_rows(alone, rule)
    other = fleet_rows(cut, rule, flown)
    np.testing.assert_allclose(one.features, other.features, atol=1e-12)
    assert learn_rule(cut, component, ~cut.mute) == learn_rule(alone, component, ~alone.mute)
    assert len(np.unique(one.life)) == len(np.unique(other.life))


def test_fold_learns_from_other_tails(fleet, base, at_once):
    """Without the removals of one tail its own prognoses are the same."""
    whole = FleetRecord(*fleet)
    month = date(2024, 4, 1)
    tail = whole.as_of(start_of(month)).lives().filter("failed")["tail"][0]
    own_fold = next(fold for fold in at_once.months[month].model.folds if tail in fold.tails)
    assert (
        sorted(t for fold in at_once.months[month].model.folds for t in fold.tails)
        == whole.features["tail"].unique().sort().to_list()
    )
    past = whole.as_of(start_of(month))
    frames = (past.features, past.messages, past.maintenance)
    others = FleetRecord(*(f.filter(~pl.col("tail").is_in(own_fold.tails)) for f in frames))
    (alone,) = fit_component(base, tracks(others.features, others.lives(), "HX"), "HX", [])
    assert alone.failures == own_fold.fits["HX"].failures
    np.testing.assert_allclose(alone.correction.weights, own_fold.fits["HX"].correction.weights, atol=1e-9)
    np.testing.assert_allclose(alone.levels, own_fold.fits["HX"].levels, atol=1e-9)


def test_night_scores_only_new_flights(fleet, base):
    at = datetime(2024, 3, 10, tzinfo=UTC)
    first = update_model(base, None, FleetRecord(*fleet).as_of(at))
    marked = replace(first, prognoses=first.prognoses.with_columns(p_event_50=pl.lit(0.123)))
    after = update_model(base, marked, FleetRecord(*fleet).as_of(at + timedelta(days=1)))
    old = after.prognoses.filter(pl.col("departed_at") < at)
    assert (old["p_event_50"] == 0.123).all()
    new = after.prognoses.filter(pl.col("departed_at") >= at, pl.col("component") == "HX")
    assert new.height == 8 * 2 * 3
    assert not (new["p_event_50"] == 0.123).any()


def without(record, share):
    """The record, and the same less a share of the flights of months past, from all over the fleet."""
    past = record.features.filter(pl.col("departed_at") < start_of(record.months()[-1]))["flight_id"].unique().sort()
    late = past.gather_every(round(1 / share))
    return replace(record, features=record.features.filter(~pl.col("flight_id").is_in(late.implode()))), late


def test_few_late_flights_are_scored(fleet, base):
    """At once, and learned from next month."""
    whole = FleetRecord(*fleet)
    one = whole.features.filter(pl.col("departed_at") < datetime(2024, 2, 20, tzinfo=UTC))["flight_id"][-1]
    missed = replace(whole, features=whole.features.filter(pl.col("flight_id") != one))
    first = update_model(base, None, missed.as_of(IN_MARCH))
    marked = replace(first, prognoses=first.prognoses.with_columns(p_event_50=pl.lit(0.123)))
    after = update_model(base, marked, whole.as_of(IN_MARCH))
    february, march = (date(2024, m, 1) for m in (2, 3))
    stays = {m: own.model.version for m, own in first.months.items()}
    assert {m: own.model.version for m, own in after.months.items()} == stays
    assert after.months[march].digest == first.months[march].digest  # it stays on record what was learned from
    assert after.months[march].service["late_flights_not_learned_from"] == 2  # of two packs
    assert after.months[february].service["late_flights_not_learned_from"] == 0
    flight = after.prognoses.filter(flight_id=one)
    assert flight.height == 4
    assert flight["model_version"].unique().to_list() == [first.months[february].model.version]
    assert not (flight["p_event_50"] == 0.123).any()
    before = pl.col("departed_at") < start_of(february)
    others = after.prognoses.filter((pl.col("tail") != flight["tail"][0]) | before)
    assert others.height
    assert (others["p_event_50"] == 0.123).all(), "what was said of a flight stands while what it follows from does"
    alone = update_model(base, None, whole.as_of(IN_MARCH)).prognoses
    scored, clean = (p.filter(component="HX", flight_id=one).sort("pack") for p in (after.prognoses, alone))
    assert (scored["p_event_50"] - clean["p_event_50"]).abs().max() < 1e-9, (
        "its own month's model had learned before it"
    )
    month_on = whole.as_of(IN_MARCH + timedelta(days=3))
    april = pl.col("departed_at") >= datetime(2024, 4, 1, tzinfo=UTC)
    same(*(update_model(base, last, month_on).prognoses.filter(april) for last in (after, None)))


@pytest.mark.parametrize("share", [0.5, 0.05])
def test_many_late_flights_retrain_at_once(fleet, base, share):
    record = FleetRecord(*fleet).as_of(IN_MARCH)
    after = update_model(base, update_model(base, None, without(record, share)[0]), record)
    assert after.newest.service["learned_because"] != "the month began"
    assert after.newest.service["late_flights_not_learned_from"] == 0
    same(after.prognoses, update_model(base, None, record).prognoses)


def test_late_message_retrains_later_months(fleet, base):
    record = FleetRecord(*fleet).as_of(IN_MARCH)
    failed = record.as_of(start_of(record.months()[-1])).lives().filter("failed").row(0, named=True)
    own = (pl.col("tail") == failed["tail"]) & (pl.col("pack") == failed["pack"])
    unheard = replace(record, messages=record.messages.filter(~own))
    first = update_model(base, None, unheard)
    after = update_model(base, first, record)
    assert after.newest.service["learned_because"].startswith("lives that had ended are others")
    assert after.months[min(after.months)] == first.months[min(first.months)]
    same(after.prognoses, update_model(base, None, record).prognoses)


def test_changed_models_retrain_every_month(fleet, base):
    record = FleetRecord(*fleet).as_of(IN_MARCH)
    changed = replace(record, features=record.features.with_columns(pl.col("hx_fouling") + 0.02))
    after = update_model(base, update_model(base, None, record, "as built"), changed, "as mended")
    assert {m.service["learned_because"] for m in after.months.values()} == {
        "the aircraft's models or the code of features are others"
    }
    same(after.prognoses, update_model(base, None, changed).prognoses)


def test_joining_aircraft_changes_no_past(fleet, base):
    whole = FleetRecord(*fleet)
    joins = (pl.col("tail") != "LX-T03") | (pl.col("departed_at") >= datetime(2024, 3, 5, tzinfo=UTC))
    record = replace(whole, features=whole.features.filter(joins)).as_of(IN_MARCH)
    first = update_model(base, None, record.as_of(datetime(2024, 3, 1, tzinfo=UTC)))
    after = update_model(base, first, record)
    same(after.prognoses, update_model(base, None, record).prognoses)
    assert after.months[date(2024, 2, 1)].model.version == first.months[date(2024, 2, 1)].model.version
    assert after.prognoses.filter(tail="LX-T03", component="HX")["rul_flights"].null_count() == 0


def test_empty_record_has_no_prognoses(fleet, base):
    empty = update_model(base, None, FleetRecord(*(frame.clear() for frame in fleet)))
    assert not empty.months
    assert empty.prognoses.is_empty()
    assert update_model(base, empty, FleetRecord(*fleet).as_of(datetime(2024, 2, 1, tzinfo=UTC))).prognoses.height
