"""When a model learns, which one serves, which flights are scored again: rules at their edges, numbers by hand."""

import json
from dataclasses import asdict, replace
from datetime import UTC, date, datetime, timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import polars as pl
import pytest
from by_hand import START, flights

from hdt_core.components import LINEAR, components
from hdt_core.margin.first_passage import wear_rate
from hdt_core.margin.margin import LN_RATIO_PER_K
from hdt_core.prognosis import base as base_module
from hdt_core.prognosis import hazard, model
from hdt_core.prognosis.component_life import _event_by, first_passage
from hdt_core.prognosis.feature_rows import PRIOR_RULES, _trailing_median, tracks
from hdt_core.prognosis.fleet_record import (
    FleetRecord,
    TrainingDigest,
    flights_not_learned,
    month_of,
    retraining_reason,
    score_months,
    start_of,
    training_digests,
)
from hdt_core.prognosis.hazard import EDGES, SPANS, event_by, events_ahead, hazards, passage_hazards, quantile
from hdt_core.prognosis.metrics import constant_interval_score, interval_score
from hdt_core.prognosis.model import (
    ComponentFit,
    Fold,
    Prognosis,
    _keep_lessons,
    prior_levels,
    split_tails,
    with_version,
)
from hdt_core.prognosis.recalibrate import NOMINAL, TERMS, HazardCorrection
from hdt_core.prognosis.service import _version_of, from_parts, model_card, promote, same_base, to_parts
from hdt_core.prognosis.unit_lives import episodes

DIGEST = TrainingDigest(
    "base", "design", ["A", "B"], ["O"], [f"life {k}" for k in range(100)], {"O|A|1": 900, "O|B|1": 100}
)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({}, ""), ({"base": "other"}, "the base is another"), ({"tails": ["A"]}, "an aircraft joined or left"),
        ({"design": "other"}, "the aircraft's models or the code of features are others"),
        ({"operators": []}, "an operator's first message came late"),
        # of a hundred lives one may be another, of a thousand flights ten may come late, or go
        ({"ended": [*DIGEST.ended[1:], "new"]}, ""), ({"ended": DIGEST.ended[1:]}, ""),
        ({"ended": [*DIGEST.ended, "new", "newer"]}, "lives that had ended are others: 2"),
        ({"ended": DIGEST.ended[2:]}, "lives that had ended are others: 2"),
        ({"flights": {"O|A|1": 905, "O|B|1": 95}}, ""), ({"flights": {"O|A|1": 890, "O|B|1": 100}}, ""),
        ({"flights": {"O|A|1": 906, "O|B|1": 95}}, "11 flights of earlier months came late or went"),
        ({"flights": {"O|A|1": 900, "O|B|1": 100, "O|C|1": 11}}, "11 flights of earlier months came late or went"),
        ({"flights": {"O|A|1": 900}}, "100 flights of earlier months came late or went"),
        ({"base": "other", "design": "other"}, "the base is another"),
    ],
)  # fmt: skip
def test_one_percent_change_retrains(change, why):
    assert retraining_reason(replace(DIGEST, **change), DIGEST) == why


def test_new_month_retrains():
    assert retraining_reason(DIGEST, None) == "the month began"


def test_digest_survives_json():
    assert TrainingDigest(**json.loads(json.dumps(asdict(DIGEST)))) == DIGEST


def test_added_flights_are_not_learned():
    now = replace(DIGEST, flights={"O|A|1": 903, "O|B|1": 90, "O|C|1": 5})
    assert flights_not_learned(now, DIGEST) == 8


def test_trailing_median_ignores_later_flights():
    per_k = np.array([[np.nan, 0.1, 0.3, np.nan, 0.2], [np.nan] * 5])
    want = [LN_RATIO_PER_K, 0.1, 0.2, 0.2, 0.2]
    np.testing.assert_allclose(_trailing_median(per_k), [want, [LN_RATIO_PER_K] * 5])


def test_interval_score_by_hand():
    assert interval_score([5.0], [6.0], [8.0], 0.5).tolist() == [2.0 + 4.0]


def test_constant_interval_score_by_hand():
    t = np.arange(11.0)
    missed = np.maximum(1.0 - t, 0) + np.maximum(t - 9.0, 0)
    assert constant_interval_score(t, 0.2) == pytest.approx(np.mean(8.0 + 10 * missed))


def fly(n: int, tail: str = "T-1", first: datetime = START, **columns: Any) -> pl.DataFrame:
    """A flight a day."""
    return flights(n, tail=tail, operator="AAA", departed_at=[first + timedelta(k) for k in range(n)], **columns)


def record(*frames: pl.DataFrame, messages: list[tuple] = [], entries: list[tuple] = []) -> FleetRecord:  # noqa: B006
    keys = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32}
    message_rows = pl.DataFrame(messages, orient="row", schema=keys | {"flight_id": pl.String, "code": pl.String,
                        "message_time": pl.Datetime("us", "UTC")})  # fmt: skip
    log = pl.DataFrame(entries, orient="row", schema=keys | {"done_on": pl.Date, "component": pl.String,
                       "action": pl.String, "finding": pl.String})  # fmt: skip
    return FleetRecord(pl.concat(frames), message_rows, log)


FEBRUARY = date(2024, 2, 1)
MARCH = date(2024, 3, 1)


@pytest.fixture(scope="module")
def winter() -> FleetRecord:
    """Two aircraft, one from February on; what came at the very beginning of that month belongs to it."""
    start = datetime(2024, 2, 1, tzinfo=UTC)
    return record(
        fly(70, first=datetime(2024, 1, 1, tzinfo=UTC)),
        fly(29, "T-2", start),
        messages=[
            ("AAA", "T-1", 1, "T-1_010", "21-52-HXTEMP", start),
            ("BBB", "T-9", 1, "x", "y", start - timedelta(1)),
        ],
        entries=[
            ("AAA", "T-1", 1, FEBRUARY, "HX", "REPLACED", ""),
            ("AAA", "T-1", 1, date(2024, 1, 13), "HX", "REPLACED", ""),
        ],
    )


def test_record_lists_its_months(winter):
    assert winter.months() == [date(2024, 1, 1), FEBRUARY, MARCH]


def test_record_is_cut_at_month(winter):
    past = winter.as_of(start_of(FEBRUARY))
    assert [f.height for f in (past.features, past.messages, past.maintenance)] == [31, 1, 1]


def test_month_begins_at_midnight():
    start = start_of(FEBRUARY)
    assert month_of(pl.Series([start - timedelta(microseconds=1), start])).to_list() == [date(2024, 1, 1), FEBRUARY]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("tails", [["T-1"], ["T-1", "T-2"], ["T-1", "T-2"]]),
        ("operators", [[], ["BBB"], ["AAA", "BBB"]]),
        ("flights", [{}, {"AAA|T-1|1": 31}, {"AAA|T-1|1": 60, "AAA|T-2|1": 29}]),
    ],
)
def test_digest_lists_the_past(winter, name, expected):
    assert [getattr(digest, name) for digest in training_digests(winter, "b", "d").values()] == expected


def test_digest_lists_ended_lives(winter):
    """The unit that left in January was followed in January, the one of 1 February by a flight of that day."""
    assert [len(digest.ended) for digest in training_digests(winter, "b", "d").values()] == [0, 1, 2]


def test_digest_names_base_with_terms(winter):
    assert training_digests(winter, "b", "d")[date(2024, 1, 1)].base == f"b {' '.join(TERMS)}"


def test_message_changes_digest_of_life(winter):
    with_message, without = (
        set(training_digests(replace(winter, messages=rows), "b", "d")[MARCH].ended)
        for rows in (winter.messages, winter.messages.clear())
    )
    assert len(with_message ^ without) == 2


def scored_days(n: int, loss: list[float]):
    rows = fly(n, hx_fouling=loss, hx_fouling_sd=0.01, hx_ln_ua_ratio=-0.1)
    none = record(rows)
    return tracks(rows, episodes(rows, none.messages, none.maintenance), "HX")


CALM = [0.1] * 60


@pytest.fixture(scope="module")
def first_scores() -> tuple:
    """What is kept of sixty calm days, and which flights were scored."""
    return score_months(scored_days(60, CALM), "HX", {})


def find_rescored(days, before, component: str = "HX") -> list[int]:
    """Flights that are scored anew."""
    return np.flatnonzero(score_months(days, component, before)[1]).tolist()


def test_new_flights_are_scored_by_month(first_scores):
    scored, new = first_scores
    assert new.all()
    assert {m: part["HX|AAA|T-1|1"][0] for m, part in scored.items()} == {date(2024, 1, 1): 31, FEBRUARY: 29}


def test_unchanged_flights_are_not_rescored(first_scores):
    again, new = score_months(scored_days(60, CALM), "HX", first_scores[0])
    assert (again, new.any()) == (first_scores[0], False)


def test_only_later_flights_are_scored():
    early = score_months(scored_days(40, CALM[:40]), "HX", {})[0]
    assert find_rescored(scored_days(60, CALM), early) == list(range(40, 60))


@pytest.mark.parametrize(("changed", "first"), [(5, 0), (40, 31), (30, 0)])
def test_changed_flight_rescores_later_ones(first_scores, changed, first):
    """From the beginning of its month."""
    other = [0.2 if k == changed else v for k, v in enumerate(CALM)]
    assert find_rescored(scored_days(60, other), first_scores[0]) == list(range(first, 60))


def test_withdrawn_flights_rescore_their_month(first_scores):
    assert find_rescored(scored_days(50, CALM[:50]), first_scores[0]) == list(range(31, 50))


def test_other_component_is_scored_anew(first_scores):
    assert find_rescored(scored_days(60, CALM), first_scores[0], "CC") == list(range(60))


PROMOTIONS = [
    ({"interval_score_flights": 102.0, "brier": 0.051}, {"interval_score_flights": 100.0, "brier": 0.05}, True),
    ({"interval_score_flights": 102.1, "brier": 0.05}, {"interval_score_flights": 100.0, "brier": 0.05}, False),
    ({"interval_score_flights": 90.0, "brier": 0.0511}, {"interval_score_flights": 100.0, "brier": 0.05}, False),
    ({"interval_score_flights": 90.0}, {"interval_score_flights": 100.0}, True),
    ({"interval_score_flights": 90.0}, {"interval_score_flights": 100.0, "brier": 0.05}, False),
    ({}, {}, True), ({"brier": 9.0}, {"failures": 3.0}, True),
]  # fmt: skip


@pytest.mark.parametrize(("candidate", "service", "promoted"), PROMOTIONS)
def test_two_percent_worse_is_rejected(candidate, service, promoted):
    assert promote({"scores": candidate}, {"scores": service}).promoted is promoted


@pytest.mark.parametrize("scores", [candidate for candidate, *_ in PROMOTIONS], ids=str)
def test_first_model_is_promoted(scores):
    assert promote({"scores": scores}, None).promoted


def test_learning_is_as_declared():
    """Members, folds, rows and failures: chosen on simulated fleets (docs/prognosis.md)."""
    assert (base_module.MEMBERS, model.FOLDS, model.LEARN_FROM, model.HORIZON) == (3, 5, 12, 300.0)
    # a member learns from every twentieth flight of fifty fleets of twenty aircraft that fly six hundred times
    assert (base_module.simulated_rows.__defaults__, base_module.fit_member.__defaults__) == ((50, 20, 600, 20), (50,))
    assert model.LESSONS == ((False, False), (True, False), (False, True), (True, True))


@pytest.mark.parametrize(("rows", "stride"), [(1, 4), (4000, 4), (4001, 5), (8000, 8), (8001, 9)])
def test_stride_limits_the_rows(rows, stride):
    assert model._stride(np.ones(rows, bool)) == stride


@pytest.mark.parametrize(
    ("tails", "folds"),
    [("gfedcba", [("a", "f"), ("b", "g"), ("c",), ("d",), ("e",)]), ("xy", [("x",), ("y",)]), ("", [])],
)
def test_tails_are_dealt_to_folds(tails, folds):
    assert split_tails(list(tails)) == folds


def test_unfitted_component_is_uncorrected():
    fit = ComponentFit(PRIOR_RULES["CC"])
    assert fit == ComponentFit(PRIOR_RULES["CC"], HazardCorrection((0.0,) * 4), NOMINAL, 0, 0)


@pytest.mark.parametrize(("component", "levels"), [("HX", (0.1, 0.4, 0.9)), ("CC", (0.05, 0.5, 0.95))])
def test_only_exchanger_takes_base_levels(component, levels):
    assert prior_levels(Prognosis((), (0.1, 0.4, 0.9)), component) == levels


@pytest.mark.parametrize("corrected", [False, True])
@pytest.mark.parametrize("levelled", [False, True])
def test_lessons_are_applied_singly(corrected, levelled):
    fit = ComponentFit(PRIOR_RULES["HX"], HazardCorrection((1.0,)), (0.2, 0.5, 0.8), 13, 20)
    result = _keep_lessons(fit, (0.1, 0.4, 0.9), corrected, levelled)
    assert any(result.correction.weights) is corrected
    assert result.levels == (fit.levels if levelled else (0.1, 0.4, 0.9))
    assert (result.rule, result.failures, result.lives) == (fit.rule, 13, 20)


def flat(chance: float, columns: int = 3) -> SimpleNamespace:
    return SimpleNamespace(
        n_features_in_=columns, predict_proba=lambda x: np.column_stack([x[:, 0], chance * x.sum(axis=1)]),
        train_score_=np.array([chance]), n_iter_=1,
    )  # fmt: skip


BASE = Prognosis((flat(0.1), flat(0.2)), (0.05, 0.5, 0.95))


@pytest.mark.parametrize(
    ("other", "is_same"),
    [
        (Prognosis((flat(0.1), flat(0.2)), BASE.base_levels), True),
        (Prognosis((flat(0.1), flat(0.21)), BASE.base_levels), False),
        (Prognosis((flat(0.1),), BASE.base_levels), False),
        (Prognosis(BASE.hazard, (0.05, 0.5, 0.94)), False),
    ],
    ids=["equal", "hazard", "members", "levels"],
)
def test_bases_compare_by_content(other, is_same):
    assert same_base(BASE, other) is is_same


def test_hazards_are_asked_in_parts(monkeypatch):
    monkeypatch.setattr(hazard, "probabilities", lambda m, x, spans: m * x[:, :1] / spans)
    rows = np.linspace(0.1, 1.0, 11)[:, None]
    whole = hazards([1.0, 3.0], rows)
    np.testing.assert_allclose(whole, 2.0 * rows / EDGES[1:])
    monkeypatch.setattr(hazard, "ROWS_AT_ONCE", 4)
    np.testing.assert_array_equal(hazards([1.0, 3.0], rows), whole)


SINGLE = Prognosis((flat(0.1),), (0.05, 0.5, 0.95))
FIT = ComponentFit(PRIOR_RULES["CC"])


def test_version_covers_all_fits():
    fits = [{}, {"CC": FIT}, {"CC": replace(FIT, levels=(0.1, 0.5, 0.9))},
            {"CC": replace(FIT, correction=HazardCorrection((0.1,)))}, {"HX": FIT}]  # fmt: skip
    versions = [with_version(SINGLE, own).version for own in fits]
    versions += [
        with_version(SINGLE, folds=(Fold(("A",), {"CC": FIT}),)).version,
        with_version(replace(SINGLE, hazard=(flat(0.2),))).version,
    ]
    assert len(set(versions)) == len(versions)
    assert {len(v) for v in versions} == {12}


def test_equal_fits_have_equal_version():
    one, other = (with_version(SINGLE, {"CC": ComponentFit(PRIOR_RULES["CC"])}).version for _ in range(2))
    assert one == other


def test_parts_restore_a_base():
    assert from_parts(to_parts(SINGLE)) == SINGLE


def test_card_counts_failures_by_component():
    fits = {"CC": replace(FIT, failures=3, lives=7), "HX": ComponentFit(PRIOR_RULES["HX"])}
    card = model_card(with_version(SINGLE, fits))
    assert (card["failures"], card["lives"], card["scores"]) == ({"CC": 3, "HX": 0}, {"CC": 7, "HX": 0}, {})
    assert card["message"]["CC"] == asdict(PRIOR_RULES["CC"])


def test_flight_has_version_of_its_month():
    frame = pl.DataFrame({"departed_at": [datetime(2024, 1, 31, 23, tzinfo=UTC), datetime(2024, 2, 1, tzinfo=UTC)]})
    at = {date(2024, 1, 1): replace(SINGLE, version="j"), FEBRUARY: replace(SINGLE, version="f")}
    assert frame.select(_version_of(at)).to_series().to_list() == ["j", "f"]


HORIZONS = (50.0, 100.0, 200.0, 300.0)
PASSAGE = event_by(passage_hazards(np.array([[0.2, 0.1, 0.8, 1.0], [0.0, 0.0, 0.0, np.nan]]), HORIZONS))


def test_passage_spreads_between_horizons():
    p_by = dict(zip(EDGES, PASSAGE[0], strict=True))
    assert (p_by[10.0], p_by[80.0], p_by[150.0], p_by[300.0]) == pytest.approx((0.04, 0.2, 0.5, 1.0))


def test_unknown_passage_stays_unknown():
    assert np.isnan(PASSAGE[1, -1])


def test_no_units_have_no_passage():
    assert passage_hazards(np.zeros((0, 4)), HORIZONS).shape == (0, SPANS)


def test_hazard_is_zero_after_last_unit():
    assert passage_hazards(np.ones((1, 4)), HORIZONS)[0, 7] == 0.0


def test_events_ahead_follow_chances():
    ahead = events_ahead(PASSAGE[:1])
    assert [ahead[f"p_event_{k}"][0] for k in (25, 50, 100, 200, 300)] == pytest.approx([0.1, 0.2, 0.2, 0.8, 1.0])


def test_quantile_is_first_flight_there():
    flat_by = np.r_[0.0, np.full(SPANS, 0.5)][None]
    assert quantile(flat_by, 0.5)[0] == pytest.approx(5.0, abs=1e-6)


@pytest.mark.parametrize(("slope", "n_seen", "flights"), [(2e-4, 29.0, 30.0), (2e-4, 150.0, 100.0), (None, 29.0, 2.0)])
def test_trend_counts_by_flights_observed(slope, n_seen, flights):
    part = components()["CC"]
    rows = pl.DataFrame(
        {"loss": [0.1], "loss_sd": [0.01], "loss_slope_100_per_flight": [slope], "flights_since_drop": [n_seen]},
        schema_overrides={"loss_slope_100_per_flight": pl.Float64},
    )
    limit = (np.array([0.25]), np.array([0.08]))
    usual = part.limit.mean / part.life_flights
    rate = wear_rate(np.array([slope or 0.0]), np.array([flights]), usual, usual)
    want = first_passage(np.array([0.1]), np.array([0.01]), *rate, limit, np.array([True]))
    np.testing.assert_allclose(_event_by(rows, limit, part, np.array([True]), LINEAR), want)
