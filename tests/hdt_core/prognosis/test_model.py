"""The whole layer on a fleet of simulated lives it was not trained on."""

import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from sklearn.ensemble import HistGradientBoostingClassifier

from benchmarks.prognosis import predict_prognosis
from hdt_core.margin.margin import PRIOR_RULE
from hdt_core.prognosis.base import fit_member
from hdt_core.prognosis.feature_rows import INPUTS, PRIOR_RULES, fleet_rows, tracks
from hdt_core.prognosis.fleet_record import FleetRecord
from hdt_core.prognosis.hazard import EDGES, event_by, fit_hazard, hazards
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses
from hdt_core.prognosis.model import (
    LESSONS,
    ComponentFit,
    Prognosis,
    _hazards,
    _lesson_scores,
    assemble,
    fit_component,
    predict_by_fold,
    split_tails,
)
from hdt_core.prognosis.recalibrate import HazardCorrection
from hdt_core.prognosis.service import fits_to_json, from_parts, model_card, promote, to_parts, update_model, with_fits
from hdt_core.prognosis.unit_lives import episodes
from pipelines.learned import shipped_base


def fit_prognosis(features: pl.DataFrame, lives: pl.DataFrame, base: Prognosis) -> Prognosis:
    """A model fitted to all of a fleet's lives."""
    return assemble(base, [], {c: fit_component(base, tracks(features, lives, c), c, []) for c in PRIOR_RULES})


@pytest.fixture(scope="module")
def base():
    """The base that is shipped: it was learned from fleets of other seeds."""
    return shipped_base()


@pytest.fixture(scope="module")
def fleet_fit(fleet, base):
    lives = episodes(*fleet)
    model = fit_prognosis(fleet[0], lives, base=base)
    return fleet[0], lives, model


@pytest.fixture(scope="module")
def forecasts(fleet, base):
    lives = episodes(*fleet)
    track = tracks(fleet[0], lives, "HX")
    folds = split_tails(fleet[0]["tail"].unique().to_list())
    model = assemble(base, folds, {"HX": fit_component(base, track, "HX", folds)})
    return join_outcomes(predict_by_fold(model, "HX", track, np.ones(len(track.at), bool)), fleet[0], lives)


@pytest.fixture(scope="module")
def prognoses(fleet_fit):
    features, lives, model = fleet_fit
    return predict_prognosis(model, features, lives)


def test_flights_have_rows_per_component(fleet_fit, prognoses):
    assert prognoses.group_by("component").len()["len"].to_list() == [fleet_fit[0].height] * 2
    assert prognoses.unique(["tail", "flight_id", "pack", "component"]).height == prognoses.height


def test_exchanger_prognoses_are_ordered(prognoses):
    hx = prognoses.filter(component="HX")
    assert hx.null_count().select(pl.sum_horizontal(pl.all())).item() == 0
    assert (hx["rul_low"] <= hx["rul_flights"]).all()
    assert (hx["rul_flights"] <= hx["rul_high"]).all()
    assert hx["p_event_50"].is_between(0.0, 1.0).all()


def test_compressor_without_track_is_blank(prognoses):
    """The rows are there, and say nothing."""
    assert prognoses.filter(component="CC")["rul_flights"].is_null().all()


@pytest.fixture(scope="module")
def middle(fleet_fit):
    """When half of the flights had departed."""
    departed = fleet_fit[0]["departed_at"].sort()
    return departed[len(departed) // 2]


def test_later_flights_change_no_prognosis(fleet_fit, prognoses, middle):
    features, lives, model = fleet_fit
    early = pl.col("departed_at") <= middle
    keys = ["component", "tail", "pack", "flight_id"]
    now, then = (
        rows.sort(keys) for rows in (predict_prognosis(model, features.filter(early), lives), prognoses.filter(early))
    )
    for name in ("rul_flights", "rul_low", "rul_high", "p_event_50"):
        np.testing.assert_allclose(now[name].to_numpy(), then[name].to_numpy(), atol=1e-9)


def test_later_flights_change_no_row(fleet_fit, middle):
    features, lives, _ = fleet_fit
    early, whole = (tracks(f, lives, "HX") for f in (features.filter(pl.col("departed_at") <= middle), features))
    now, then = (fleet_rows(t, {"": PRIOR_RULE}).features for t in (early, whole))
    np.testing.assert_array_equal(now, then[(whole.keys["departed_at"] <= middle).to_numpy()])


def test_unseen_lives_are_forecast(forecasts):
    scores = score_prognoses(forecasts)
    remaining = forecasts.filter(pl.col("failed") | (pl.col("remaining") >= 300))["remaining"].clip(0, 300).to_numpy()
    constant = np.abs(remaining - np.median(remaining)).mean()
    assert scores["mae_flights"] < 0.9 * constant
    assert scores["interval_skill"] > 0.2
    assert 0.8 < scores["coverage"] < 1.0
    assert scores["brier_skill"] > 0.25
    assert scores["auc"] > 0.9


def test_forecasts_without_any_failure(fleet, base):
    features, messages, maintenance = fleet
    quiet = episodes(features, messages.clear(), maintenance.clear())
    model = fit_prognosis(features.clear(), quiet.clear(), base=base)
    lives = episodes(*fleet)
    scores = score_prognoses(join_outcomes(predict_prognosis(model, features, lives), features, lives))
    assert scores["auc"] > 0.9
    assert scores["mae_flights"] < 60.0


def test_stored_parts_restore_the_model(fleet_fit):
    features, lives, model = fleet_fit
    sio = pytest.importorskip("skops.io")
    blob = sio.dumps(to_parts(model))
    types = sio.get_untrusted_types(data=blob)
    assert not [t for t in types if t.startswith("hdt_core")]
    again = with_fits(from_parts(sio.loads(blob, trusted=types)), json.loads(json.dumps(fits_to_json(model))))
    head = features.filter(pl.col("tail") == "LX-T00")
    assert predict_prognosis(again, head, lives).equals(predict_prognosis(model, head, lives))


def test_older_home_restores_fits(fleet_fit):
    model = fleet_fit[2]
    older = json.dumps(fits_to_json(model)).replace('"rule": ', '"says": ')
    assert '"rule"' not in older
    assert with_fits(model, json.loads(older)).fits == model.fits


def test_same_lives_give_same_version(fleet_fit):
    features, lives, model = fleet_fit
    assert fit_prognosis(features, lives, base=shipped_base()).version == model.version


def test_same_seed_gives_same_base():
    one, other = (fit_member(4, fleets=3) for _ in range(2))
    probe = np.random.default_rng(0).standard_normal((50, len(INPUTS) + 1))
    np.testing.assert_array_equal(one.predict_proba(probe), other.predict_proba(probe))


@pytest.fixture
def cards(fleet_fit):
    """Of the model, and of one whose intervals are worse."""
    return [model_card(fleet_fit[2], {"interval_score_flights": score, "brier": 0.05}) for score in (150.0, 180.0)]


def test_first_model_is_promoted(cards):
    assert promote(cards[0], None).promoted


def test_better_model_is_promoted(cards):
    assert promote(*cards).promoted


def test_worse_model_is_not_promoted(cards):
    verdict = promote(*reversed(cards))
    assert not verdict.promoted
    assert "interval_score" in verdict.reason


def test_unscored_model_is_not_promoted(fleet_fit, cards):
    assert not promote(model_card(fleet_fit[2]), cards[0]).promoted


def test_card_is_json(cards):
    json.dumps(cards[0])


def test_service_keeps_better_model(fleet, fleet_fit):
    features, _, model = fleet_fit
    record = FleetRecord(*fleet)
    blind = replace(model, base_levels=(0.45, 0.5, 0.55), fits={})
    blind = replace(blind, hazard=tuple(_contrary(features.height) for _ in model.hazard))
    first = update_model(model, None, record)
    assert first.newest.service["promoted"]
    assert first.newest.card["scores"]["failures"] > 5
    again = update_model(blind, first, record)
    assert not again.newest.service["promoted"]
    assert "worse" in again.newest.service["promotion"]
    assert again.newest.model.version == first.newest.model.version
    assert again.prognoses.equals(first.prognoses)
    unchanged = update_model(blind, again, record)
    assert unchanged.newest.service == again.newest.service
    better = update_model(model, update_model(blind, None, record), record)
    assert better.newest.service["promoted"]
    assert better.newest.model.version == first.newest.model.version


def _contrary(seed: int) -> HistGradientBoostingClassifier:
    """A hazard that knows nothing: learned from noise."""
    rng = np.random.default_rng(seed)
    rows = rng.standard_normal((400, len(INPUTS)))
    return fit_hazard(rows, rng.uniform(1.0, 300.0, 400), np.ones(400, bool), seed=0)


@pytest.fixture(scope="module")
def tail_halves(fleet, base):
    """Tracks of the fleet, and each half of its tails."""
    track = tracks(fleet[0], episodes(*fleet), "HX")
    tails = track.keys["tail"].unique().sort().to_list()
    return track, [tuple(tails[::2]), tuple(tails[1::2])]


@pytest.fixture(scope="module")
def outside_halves(tail_halves):
    """Tracks, and of each half which rows lie outside it."""
    track, tail_groups = tail_halves
    return track, [~track.keys["tail"].is_in(names).to_numpy() for names in tail_groups]


@pytest.fixture(scope="module")
def high_base(base):
    """The base with log odds 2 too high."""
    high = deepcopy(base.hazard[0])
    high._baseline_prediction = high._baseline_prediction + 2.0
    return replace(base, hazard=(high,))


each_wrong_fit = pytest.mark.parametrize(
    ("base_levels", "weights", "levels", "expected"),
    [
        ((0.05, 0.5, 0.95), (6.0, 0.0, 0.0, 0.0), (0.05, 0.5, 0.95), (False, False)),  # every unit about to fail
        ((0.05, 0.5, 0.95), (0.0, 0.0, 0.0, 0.0), (0.49, 0.5, 0.51), (False, False)),  # no interval at all
        ((0.49, 0.5, 0.51), (0.0, 0.0, 0.0, 0.0), (0.05, 0.5, 0.95), (False, True)),  # an interval for none
    ],
)


@each_wrong_fit
def test_only_helpful_lessons_are_learned(base, outside_halves, base_levels, weights, levels, expected):
    """Those that narrow the interval score of lives outside their fold."""
    track, outside = outside_halves
    fit = ComponentFit({"": PRIOR_RULE}, HazardCorrection(weights), levels, failures=5, lives=9)
    scores = _lesson_scores(replace(base, base_levels=base_levels), track, "HX", outside, [fit, fit])
    assert LESSONS[int(np.argmin(scores.sum(axis=0)))] == expected


@each_wrong_fit
def test_mute_fold_scores_nothing(base, outside_halves, base_levels, weights, levels, expected):
    track, outside = outside_halves
    fit = ComponentFit({"": PRIOR_RULE}, HazardCorrection(weights), levels, failures=5, lives=9)
    muted = replace(track, mute=track.mute | ~outside[1])
    own = _lesson_scores(base, muted, "HX", outside, [fit, fit])
    assert (own > 0.0).tolist() == [[True] * len(LESSONS), [False] * len(LESSONS)]


def test_fold_ignores_its_own_lives(base, tail_halves, monkeypatch):
    """Of three folds the first's lives want the correction most; the first alone is judged by the others."""
    track, tail_groups = tail_halves
    track_folds = [tail_groups[0][:1], tail_groups[0][1:], tail_groups[1]]
    scores = np.array([[9.0, 0.0, 9.0, 9.0], [1.0, 2.0, 9.0, 9.0], [1.0, 2.0, 9.0, 9.0]])
    monkeypatch.setattr("hdt_core.prognosis.model._lesson_scores", lambda *_: scores)
    weights = (0.5, 0.0, 0.0, 0.0)
    learned = ComponentFit({"": PRIOR_RULE}, HazardCorrection(weights), (0.2, 0.5, 0.8), failures=12, lives=19)
    monkeypatch.setattr("hdt_core.prognosis.model._learn", lambda *_: learned)
    fits = fit_component(base, track, "HX", track_folds)
    assert [fit.correction.weights == weights for fit in fits] == [True, False, True, True]
    assert all(fit.levels == base.base_levels for fit in fits)


def test_pessimistic_base_is_corrected(high_base, tail_halves, monkeypatch):
    """What a fleet's lives say of it narrows the score, so it is kept in every fold."""
    monkeypatch.setattr("hdt_core.prognosis.model.LEARN_FROM", 1)
    track, tail_groups = tail_halves
    fits = fit_component(high_base, track, "HX", tail_groups)
    assert all(fit.correction.weights[0] < -0.2 for fit in fits)


@pytest.mark.parametrize(("limit", "corrected"), [(None, True), (1, False)])
def test_few_failures_correct_nothing(high_base, tail_halves, monkeypatch, limit, corrected):
    """Below the limit the base stands."""
    track, tail_groups = tail_halves
    failures = fit_component(high_base, track, "HX", tail_groups)[0].failures
    monkeypatch.setattr("hdt_core.prognosis.model.LEARN_FROM", 1 if limit is None else failures + limit)
    whole = fit_component(high_base, track, "HX", tail_groups)[0]
    assert any(whole.correction.weights) == corrected
    assert whole.failures == failures


def test_compressor_is_never_corrected(high_base, tail_halves, monkeypatch):
    monkeypatch.setattr("hdt_core.prognosis.model.LEARN_FROM", 1)
    track, tail_groups = tail_halves
    assert not any(fit_component(high_base, track, "CC", tail_groups)[0].correction.weights)


@pytest.mark.parametrize(("limit", "corrected"), [(0, True), (1, False)])
def test_component_learns_at_limit(base, tail_halves, monkeypatch, limit, corrected):
    track, _ = tail_halves
    failures = fit_component(base, track, "HX", [])[0].failures
    monkeypatch.setattr("hdt_core.prognosis.model.LEARN_FROM", failures + limit)
    assert any(fit_component(base, track, "HX", [])[0].correction.weights) == corrected


@pytest.fixture(scope="module")
def passages():
    """Rows of a unit with a first passage by 50, 100, 200 and 300 flights, and of one without."""
    features = np.full((2, len(INPUTS)), np.nan)
    features[0, [INPUTS.index(f"passage_{k}") for k in (50, 100, 200, 300)]] = 0.2, 0.6, 0.6, 1.0
    return features


def test_compressor_hazard_is_first_passage(base, passages):
    at = dict(zip(EDGES, event_by(_hazards(base, "CC", passages))[0], strict=True))
    expected = {50.0: 0.2, 80.0: 0.2 + 0.4 * 30 / 50, 200.0: 0.6, 300.0: 1.0}
    assert {flights: at[flights] for flights in expected} == pytest.approx(expected)


def test_unknown_passage_leaves_base_hazard(base, passages):
    by, learned = (event_by(h) for h in (_hazards(base, "CC", passages), hazards(base.hazard, passages)))
    np.testing.assert_array_equal(by[1], learned[1])


def test_exchanger_hazard_is_that_of_base(base, passages):
    np.testing.assert_array_equal(event_by(_hazards(base, "HX", passages)), event_by(hazards(base.hazard, passages)))
