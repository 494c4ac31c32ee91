"""When a model learns, which one serves, which flights are scored again: rules at their edges, numbers by hand."""

import json
from dataclasses import asdict, replace
from datetime import UTC, date, datetime, timedelta
from types import SimpleNamespace

import numpy as np
import polars as pl
import pytest

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
    assert retraining_reason(DIGEST, None) == "the month began"
    assert TrainingDigest(**json.loads(json.dumps(asdict(DIGEST)))) == DIGEST


def test_added_flights_are_not_learned():
    now = replace(DIGEST, flights={"O|A|1": 903, "O|B|1": 90, "O|C|1": 5})
    assert flights_not_learned(now, DIGEST) == 8
    per_k = np.array([[np.nan, 0.1, 0.3, np.nan, 0.2], [np.nan] * 5])
    want = [LN_RATIO_PER_K, 0.1, 0.2, 0.2, 0.2]
    np.testing.assert_allclose(_trailing_median(per_k), [want, [LN_RATIO_PER_K] * 5])
    assert interval_score([5.0], [6.0], [8.0], 0.5).tolist() == [2.0 + 4.0]
    t = np.arange(11.0)
    low = 1.0
    high = 9.0
    missed = np.maximum(low - t, 0) + np.maximum(t - high, 0)
    assert constant_interval_score(t, 0.2) == pytest.approx(np.mean((high - low) + 10 * missed))


def flown(n: int, tail: str = "T-1", first: datetime = datetime(2024, 1, 1, 6, tzinfo=UTC), **columns) -> pl.DataFrame:
    at = [first + timedelta(k) for k in range(n)]
    frame = pl.DataFrame({"flight_id": [f"{tail}_{k:03d}" for k in range(n)], "departed_at": at})
    named = frame.with_columns(operator=pl.lit("AAA"), tail=pl.lit(tail), pack=pl.lit(1, pl.Int32))
    return named.with_columns(**{c: pl.Series(v) if isinstance(v, list) else pl.lit(v) for c, v in columns.items()})


def record(*frames: pl.DataFrame, messages: list[tuple] = [], entries: list[tuple] = []) -> FleetRecord:  # noqa: B006
    keys = {"operator": pl.String, "tail": pl.String, "pack": pl.Int32}
    message_rows = pl.DataFrame(messages, orient="row", schema=keys | {"flight_id": pl.String, "code": pl.String,
                        "message_time": pl.Datetime("us", "UTC")})  # fmt: skip
    log = pl.DataFrame(entries, orient="row", schema=keys | {"done_on": pl.Date, "component": pl.String,
                       "action": pl.String, "finding": pl.String})  # fmt: skip
    return FleetRecord(pl.concat(frames), message_rows, log)


FEBRUARY = date(2024, 2, 1)
MARCH = date(2024, 3, 1)


def test_record_is_cut_at_month():
    start = datetime(2024, 2, 1, tzinfo=UTC)
    fleet = record(
        flown(70, first=datetime(2024, 1, 1, tzinfo=UTC)),
        flown(29, "T-2", start),
        messages=[
            ("AAA", "T-1", 1, "T-1_010", "21-52-HXTEMP", start),
            ("BBB", "T-9", 1, "x", "y", start - timedelta(1)),
        ],
        entries=[
            ("AAA", "T-1", 1, FEBRUARY, "HX", "REPLACED", ""),
            ("AAA", "T-1", 1, date(2024, 1, 13), "HX", "REPLACED", ""),
        ],
    )
    assert fleet.months() == [date(2024, 1, 1), FEBRUARY, MARCH]
    past = fleet.as_of(start_of(FEBRUARY))
    assert [f.height for f in (past.features, past.messages, past.maintenance)] == [31, 1, 1]
    assert month_of(pl.Series([start - timedelta(microseconds=1), start])).to_list() == [date(2024, 1, 1), FEBRUARY]
    digests = training_digests(fleet, "b", "d")
    january, february, march = digests.values()
    assert (january.tails, february.tails, march.tails) == (["T-1"], ["T-1", "T-2"], ["T-1", "T-2"])
    assert (january.operators, february.operators, march.operators) == ([], ["BBB"], ["AAA", "BBB"])
    assert (january.flights, february.flights) == ({}, {"AAA|T-1|1": 31})
    assert march.flights == {"AAA|T-1|1": 60, "AAA|T-2|1": 29}
    # the unit that left in January was followed in January, the one of 1 February by a flight of that day
    assert [len(d.ended) for d in (january, february, march)] == [0, 1, 2]
    assert january.base == f"b {' '.join(TERMS)}"
    other = training_digests(replace(fleet, messages=fleet.messages.head(0)), "b", "d")[MARCH]
    assert len(set(other.ended) ^ set(march.ended)) == 2  # whether a message ended it is part of a life's digest


def scored_days(n: int, loss: list[float]):
    rows = flown(n, hx_fouling=loss, hx_fouling_sd=0.01, hx_ln_ua_ratio=-0.1)
    none = record(rows)
    return tracks(rows, episodes(rows, none.messages, none.maintenance), "HX")


def test_changed_flight_rescores_later_ones():
    calm = [0.1] * 60
    scored, new = score_months(scored_days(60, calm), "HX", {})
    assert new.all()
    assert {m: part["HX|AAA|T-1|1"][0] for m, part in scored.items()} == {date(2024, 1, 1): 31, FEBRUARY: 29}
    again, new = score_months(scored_days(60, calm), "HX", scored)
    assert (again, new.any()) == (scored, False)
    early = score_months(scored_days(40, calm[:40]), "HX", {})[0]
    assert np.flatnonzero(score_months(scored_days(60, calm), "HX", early)[1]).tolist() == list(range(40, 60))
    for changed, first in ((5, 0), (40, 31), (30, 0)):
        other = [0.2 if k == changed else v for k, v in enumerate(calm)]
        new = score_months(scored_days(60, other), "HX", scored)[1]
        assert np.flatnonzero(new).tolist() == list(range(first, 60))
    # withdrawn flights: the month is another, and so is all after it
    fewer = score_months(scored_days(50, calm[:50]), "HX", scored)[1]
    assert np.flatnonzero(fewer).tolist() == list(range(31, 50))
    assert score_months(scored_days(60, calm), "CC", scored)[1].all()


@pytest.mark.parametrize(
    ("candidate", "service", "promoted"),
    [
        ({"interval_score_flights": 102.0, "brier": 0.051}, {"interval_score_flights": 100.0, "brier": 0.05}, True),
        ({"interval_score_flights": 102.1, "brier": 0.05}, {"interval_score_flights": 100.0, "brier": 0.05}, False),
        ({"interval_score_flights": 90.0, "brier": 0.0511}, {"interval_score_flights": 100.0, "brier": 0.05}, False),
        ({"interval_score_flights": 90.0}, {"interval_score_flights": 100.0}, True),
        ({"interval_score_flights": 90.0}, {"interval_score_flights": 100.0, "brier": 0.05}, False),
        ({}, {}, True), ({"brier": 9.0}, {"failures": 3.0}, True),
    ],
)  # fmt: skip
def test_two_percent_worse_is_rejected(candidate, service, promoted):
    assert promote({"scores": candidate}, {"scores": service}).promoted is promoted
    assert promote({"scores": candidate}, None).promoted


def test_learning_is_as_declared():
    """Members, folds, rows and failures: chosen on simulated fleets (docs/prognosis.md)."""
    assert (base_module.MEMBERS, model.FOLDS, model.LEARN_FROM, model.HORIZON) == (3, 5, 12, 300.0)
    # a member learns from every twentieth flight of fifty fleets of twenty aircraft that fly six hundred times
    assert (base_module.simulated_rows.__defaults__, base_module.fit_member.__defaults__) == ((50, 20, 600, 20), (50,))
    for rows, stride in ((1, 4), (4000, 4), (4001, 5), (8000, 8), (8001, 9)):
        assert model._stride(np.ones(rows, bool)) == stride
    assert split_tails(list("gfedcba")) == [("a", "f"), ("b", "g"), ("c",), ("d",), ("e",)]
    assert split_tails(["x", "y"]) == [("x",), ("y",)]
    assert split_tails([]) == []
    assert model.LESSONS == ((False, False), (True, False), (False, True), (True, True))
    assert ComponentFit(PRIOR_RULES["CC"]) == ComponentFit(
        PRIOR_RULES["CC"], HazardCorrection((0.0,) * 4), NOMINAL, 0, 0
    )
    base = Prognosis((), (0.1, 0.4, 0.9))
    assert (prior_levels(base, "HX"), prior_levels(base, "CC")) == ((0.1, 0.4, 0.9), (0.05, 0.5, 0.95))
    fit = ComponentFit(PRIOR_RULES["HX"], HazardCorrection((1.0,)), (0.2, 0.5, 0.8), 13, 20)
    for corrected in (False, True):
        for levelled in (False, True):
            result = _keep_lessons(fit, (0.1, 0.4, 0.9), corrected, levelled)
            assert any(result.correction.weights) is corrected
            assert result.levels == (fit.levels if levelled else (0.1, 0.4, 0.9))
            assert (result.rule, result.failures, result.lives) == (fit.rule, 13, 20)


def flat(chance: float, columns: int = 3) -> SimpleNamespace:
    return SimpleNamespace(
        n_features_in_=columns, predict_proba=lambda x: np.column_stack([x[:, 0], chance * x.sum(axis=1)]),
        train_score_=np.array([chance]), n_iter_=1,
    )  # fmt: skip


def test_bases_compare_by_content(monkeypatch):
    one = Prognosis((flat(0.1), flat(0.2)), (0.05, 0.5, 0.95))
    assert same_base(one, Prognosis((flat(0.1), flat(0.2)), (0.05, 0.5, 0.95)))
    for other in (Prognosis((flat(0.1), flat(0.21)), one.base_levels), Prognosis((flat(0.1),), one.base_levels),
                  Prognosis(one.hazard, (0.05, 0.5, 0.94))):  # fmt: skip
        assert not same_base(one, other)
    monkeypatch.setattr(hazard, "probabilities", lambda m, x, spans: m * x[:, :1] / spans)
    rows = np.linspace(0.1, 1.0, 11)[:, None]
    whole = hazards([1.0, 3.0], rows)
    np.testing.assert_allclose(whole, 2.0 * rows / EDGES[1:])
    monkeypatch.setattr(hazard, "ROWS_AT_ONCE", 4)
    np.testing.assert_array_equal(hazards([1.0, 3.0], rows), whole)


def test_version_covers_all_fits():
    base = Prognosis((flat(0.1),), (0.05, 0.5, 0.95))
    fit = ComponentFit(PRIOR_RULES["CC"])
    learned = [{}, {"CC": fit}, {"CC": replace(fit, levels=(0.1, 0.5, 0.9))},
               {"CC": replace(fit, correction=HazardCorrection((0.1,)))}, {"HX": fit}]  # fmt: skip
    versions = [with_version(base, fits).version for fits in learned]
    versions += [
        with_version(base, folds=(Fold(("A",), {"CC": fit}),)).version,
        with_version(replace(base, hazard=(flat(0.2),))).version,
    ]
    assert len(set(versions)) == len(versions)
    assert {len(v) for v in versions} == {12}
    assert with_version(base, learned[1]).version == versions[1]
    assert from_parts(to_parts(base)) == base
    fits = {"CC": replace(fit, failures=3, lives=7), "HX": ComponentFit(PRIOR_RULES["HX"])}
    card = model_card(with_version(base, fits))
    assert (card["failures"], card["lives"], card["scores"]) == ({"CC": 3, "HX": 0}, {"CC": 7, "HX": 0}, {})
    assert card["message"]["CC"] == asdict(PRIOR_RULES["CC"])
    frame = pl.DataFrame({"departed_at": [datetime(2024, 1, 31, 23, tzinfo=UTC), datetime(2024, 2, 1, tzinfo=UTC)]})
    at = {date(2024, 1, 1): replace(base, version="j"), FEBRUARY: replace(base, version="f")}
    assert frame.select(_version_of(at)).to_series().to_list() == ["j", "f"]


def test_passage_spreads_between_horizons():
    by = passage_hazards(np.array([[0.2, 0.1, 0.8, 1.0], [0.0, 0.0, 0.0, np.nan]]), (50.0, 100.0, 200.0, 300.0))
    p_by = dict(zip(EDGES, event_by(by)[0], strict=True))
    assert (p_by[10.0], p_by[80.0], p_by[150.0], p_by[300.0]) == pytest.approx((0.04, 0.2, 0.5, 1.0))
    assert np.isnan(event_by(by)[1, -1])
    assert passage_hazards(np.zeros((0, 4)), (50.0, 100.0, 200.0, 300.0)).shape == (0, SPANS)
    sure = passage_hazards(np.ones((1, 4)), (50.0, 100.0, 200.0, 300.0))
    assert sure[0, 7] == 0.0  # nobody is left after fifty flights
    ahead = events_ahead(event_by(by[:1]))
    assert [ahead[f"p_event_{k}"][0] for k in (25, 50, 100, 200, 300)] == pytest.approx([0.1, 0.2, 0.2, 0.8, 1.0])
    flat = np.r_[0.0, np.full(SPANS, 0.5)][None]
    assert quantile(flat, 0.5)[0] == pytest.approx(5.0, abs=1e-6)


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
