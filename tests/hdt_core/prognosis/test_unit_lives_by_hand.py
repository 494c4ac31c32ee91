"""Lives, limits, tracks and scores of a few flights that can be counted on paper."""

from dataclasses import replace
from datetime import timedelta
from typing import Any

import numpy as np
import polars as pl
import pytest
from by_hand import START, flights

from benchmarks.prognosis import calibration
from hdt_core.components import LINEAR, Limit, components
from hdt_core.margin.exchanger_demand import CRITICAL
from hdt_core.margin.margin import MessageRule
from hdt_core.prognosis.base import draw_fleets, simulated_rows
from hdt_core.prognosis.choices import NO_WASHES
from hdt_core.prognosis.component_life import component_choices, component_prognoses, first_passage, learn_limit
from hdt_core.prognosis.feature_rows import FEATURES, LN_RATIO_PER_K, Tracks, fleet_rows, learn_rule, tracks
from hdt_core.prognosis.hazard import quantile
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses
from hdt_core.prognosis.unit_lives import episodes, flight_rows, life_table, with_lives

HX_CODE = "21-52-HXTEMP"
CC_CODE = "21-51-CCFLOW"


def fly(n: int, tail: str = "T-1", **columns: object) -> pl.DataFrame:
    """A flight a day of pack 1."""
    return flights(n, tail=tail, **({"operator": "AAA"} | columns))


def of_pack(tail: str, rows: list[tuple], schema: dict[str, Any]) -> pl.DataFrame:
    """Rows of pack 1."""
    frame = pl.DataFrame(rows, schema=schema, orient="row")
    return frame.with_columns(operator=pl.lit("AAA"), tail=pl.lit(tail), pack=pl.lit(1, pl.Int32))


def faults_on(*rows: tuple[int, str], tail: str = "T-1") -> pl.DataFrame:
    """Messages: on which flight, which code."""
    schema = {"flight_id": pl.String, "code": pl.String, "message_time": pl.Datetime("us", "UTC")}
    return of_pack(tail, [(f"{tail}_{k:03d}", code, START + timedelta(k)) for k, code in rows], schema)


def log(*rows: tuple[int, str, str, str], tail: str = "T-1") -> pl.DataFrame:
    """Entries: on the day of which flight, component, action, finding."""
    schema = {"done_on": pl.Date, "component": pl.String, "action": pl.String, "finding": pl.String}
    return of_pack(tail, [((START + timedelta(k)).date(), *row) for k, *row in rows], schema)


def list_lives(messages: pl.DataFrame, entries: pl.DataFrame, n: int = 100) -> list[tuple]:
    lives = episodes(fly(n), messages, entries).filter(component="HX")
    return lives.select("first_row", "end_row", "failed", "removed", "age_known").rows()


CHANGED = (59, "HX", "REPLACED", "FOULED")


@pytest.mark.parametrize(("flight", "failed"), [(39, False), (40, True), (59, True), (60, True), (61, False)])
def test_message_ends_replaced_life(flight, failed):
    """Within twenty flights. The entry is of flight 59's day: the new unit flies from flight 60 on."""
    first, second = list_lives(faults_on((flight, HX_CODE)), log(CHANGED))
    assert first == (0, flight if failed else 60, failed, True, False)
    assert second == (60, 100, False, False, True)


@pytest.mark.parametrize("flight_id", [None, "T-1_999"], ids=["none named", "not on record"])
@pytest.mark.parametrize(("hours", "end"), [(0.0, 50), (23.0, 50), (-1.0, 49)])
def test_message_without_flight_is_of_the_last_before(flight_id, hours, end):
    sent = faults_on((50, HX_CODE)).with_columns(
        pl.col("message_time") + timedelta(hours=hours), flight_id=pl.lit(flight_id, pl.String)
    )
    assert list_lives(sent, log(CHANGED))[0] == (0, end, True, True, False)


def test_message_long_after_the_last_flight_is_of_none():
    late = faults_on((58, HX_CODE)).with_columns(flight_id=pl.lit(None, pl.String))
    lives = episodes(fly(55), late, log((54, "HX", "REPLACED", "FOULED"))).filter(component="HX")
    assert lives["failed"].to_list() == [False]


def test_first_message_ends_a_life():
    several = pl.concat([faults_on((45, HX_CODE)), faults_on((50, HX_CODE)), faults_on((42, CC_CODE))])
    assert list_lives(several, log(CHANGED))[0] == (0, 45, True, True, False)


def test_wash_ends_no_life():
    washed = log((59, "HX", "CLEANED", "FOULED"))
    assert list_lives(faults_on((45, HX_CODE)), washed) == [(0, 100, False, False, False)]


def test_calibration_is_by_tenths():
    table = calibration([0, 1, 1, 0, 1], [0.05, 0.1, 0.19, 1.0, 0.96])
    assert table.rows() == [(0.05, 0.0, 1), (pytest.approx(0.145), 1.0, 2), (0.98, 0.5, 2)]


@pytest.mark.parametrize(
    ("days", "component", "failed"),
    [(0, "HX", True), (1, "HX", False), (3, "HX", False), (4, "HX", True), (1, "CC", True)],
)
def test_sound_inspection_revokes_failure(days, component, failed):
    """Of that component, within three days."""
    sound = (50 + days, component, "INSPECTED", "NO_FAULT_FOUND")
    assert list_lives(faults_on((50, HX_CODE)), log(CHANGED, sound))[0][2] == failed


HUNDRED = fly(100)


def hundred_lives(messages: pl.DataFrame) -> pl.DataFrame:
    return episodes(HUNDRED, messages, log(CHANGED))


def test_life_table_names_ending():
    lives = life_table(HUNDRED, hundred_lives(faults_on((50, HX_CODE)))).filter(component="HX")
    assert lives.select("ended_by", "censored", "n_flights", "first_flight_id", "end_flight_id").rows() == [
        ("message", False, 50, "T-1_000", "T-1_050"),
        (None, True, 40, "T-1_060", "T-1_099"),
    ]


@pytest.mark.parametrize(
    ("messages", "ending"), [(faults_on((50, CC_CODE)), "replaced"), (faults_on(), "unheard")], ids=["heard", "silent"]
)
def test_life_without_message_ends_replaced(messages, ending):
    quiet = life_table(HUNDRED, hundred_lives(messages)).filter(component="HX")
    assert quiet.select("ended_by", "end_flight_id").rows() == [(ending, "T-1_059"), (None, "T-1_099")]


def test_flights_count_down_their_life():
    rows = with_lives(flight_rows(HUNDRED), hundred_lives(faults_on((50, HX_CODE))), "HX")
    assert rows["remaining"].to_list() == [50.0 - k for k in range(60)] + [40.0 - k for k in range(40)]
    assert rows["life_id"].to_list() == [0] * 60 + [1] * 40


REPLACED = log((69, "HX", "REPLACED", "FOULED"))


def test_outcomes_follow_lives():
    """An event within 50 flights, none, or nobody knows; the message's flight and those with its unit have none."""
    features = fly(160)
    lives = episodes(features, faults_on((60, HX_CODE)), REPLACED)
    prognoses = pl.concat(features.with_columns(component=pl.lit(component)) for component in ("HX", "CC"))
    by_flight = dict(join_outcomes(prognoses, features, lives).select("flight_id", "event_50").rows())
    assert [by_flight[f"T-1_{k:03d}"] for k in (0, 9, 10, 59, 70, 109, 110, 159)] == [0, 0, 1, 1, 0, 0, None, None]
    assert not {"T-1_060", "T-1_065"} & by_flight.keys()


@pytest.fixture(scope="module")
def two_operators() -> tuple[pl.DataFrame, pl.DataFrame]:
    """Flights delivered under both, a message reported under one; and their lives."""
    features = pl.concat([fly(160), fly(160, operator="BBB")])
    entries = pl.concat([REPLACED, REPLACED.with_columns(operator=pl.lit("BBB"))])
    return features, episodes(features, faults_on((60, HX_CODE)), entries)


def test_other_operators_pack_has_not_failed(two_operators):
    lives = two_operators[1].filter(component="HX", life=0)
    assert lives.select("operator", "failed").rows() == [("AAA", True), ("BBB", False)]


def test_operators_have_outcomes_of_own(two_operators):
    features, lives = two_operators
    outcomes = join_outcomes(features.with_columns(component=pl.lit("HX")), features, lives)
    by_operator = outcomes.filter(flight_id="T-1_059").select("operator", "remaining", "failed").rows()
    assert sorted(by_operator) == [("AAA", 1.0, True), ("BBB", 11.0, False)]


def test_scores_by_hand():
    prognoses = pl.DataFrame({
        "remaining": [100.0, 120.0, 350.0, 299.0], "failed": [True, True, False, False], "life": [0, 0, 1, 2],
        "rul_flights": [110.0, 100.0, 290.0, 200.0], "rul_low": [20.0, 60.0, 250.0, 100.0],
        "rul_high": [150.0, 110.0, 300.0, 300.0], "event_50": [1.0, 0.0, 0.0, 0.0], "p_event_50": [0.6, 0.2, 0.0, 0.1],
    })  # fmt: skip
    scores = score_prognoses(prognoses)
    truth = np.array([100.0, 120.0, 300.0])  # the last was not watched for 300 flights
    low, high = np.quantile(truth, [0.05, 0.95])
    constant = np.mean([high - low + 20.0 * (max(low - t, 0.0) + max(t - high, 0.0)) for t in truth])
    score = np.mean([130.0, 50.0 + 20.0 * 10.0, 50.0])
    assert scores == pytest.approx({
        "failures": 1.0, "mae_flights": 40.0 / 3.0, "interval_score_flights": score, "coverage": 2.0 / 3.0,
        "interval_skill": 1.0 - score / constant, "coverage_last_100": 1.0, "alpha_lambda_20": 1.0,
        "brier": (0.16 + 0.04 + 0.01) / 4.0, "brier_skill": 1.0 - (0.21 / 4.0) / (0.25 * 0.75), "auc": 1.0,
    })  # fmt: skip


CC = components()["CC"]


def make_features(n: int, tail: str, loss: float | list[float]) -> pl.DataFrame:
    own = {"component": "CC", "loss_sd": 0.01, "loss_slope_100_per_flight": 2e-4, "flights_since_drop": 29}
    return fly(n, tail, loss=loss, **own)


@pytest.fixture(scope="module")
def renewals() -> pl.DataFrame:
    """Prognoses of three tails: one fails at 0.15 in February, one at 0.30 in March."""
    renewed = [
        make_features(100, "T-1", [0.15] * 45 + [0.02] * 55),
        make_features(100, "T-2", [0.30] * 75 + [0.02] * 25),
    ]
    rows = pl.concat([*renewed, make_features(100, "T-3", 0.12)])
    messages = pl.concat([faults_on((0, HX_CODE), (40, CC_CODE)), faults_on((70, CC_CODE), tail="T-2")])
    entries = pl.concat([log((44, "CC", "REPLACED", "")), log((74, "CC", "REPLACED", ""), tail="T-2")])
    return component_prognoses(rows, messages, entries, replace(CC, wear_law=LINEAR))


def passage_by_hand(levels: list[float], loss: float) -> np.ndarray:
    """Chances of a unit with this loss where failures at these levels are known."""
    limit = learn_limit(np.array(levels), Limit(0.25, 0.06, 0.05))
    usual = 0.25 / 2000.0
    error = 12.0 * 0.010**2 / 30.0**3 + (0.25 * usual) ** 2
    weight = usual**2 / (usual**2 + error)
    rate = weight * 2e-4 + (1.0 - weight) * usual
    rate_sd = np.sqrt(weight * error)
    at = (np.array([limit.mean]), np.array([np.hypot(limit.sd, 0.05)]))
    return first_passage(*(np.array([v]) for v in (loss, 0.01, rate, rate_sd)), at, np.array([True]))


@pytest.mark.parametrize(
    ("tail", "flight", "levels", "loss"),
    [
        ("T-3", 40, [], 0.12), ("T-3", 59, [], 0.12), ("T-3", 60, [0.15], 0.12), ("T-3", 90, [0.15], 0.12),
        ("T-3", 91, [0.15, 0.30], 0.12), ("T-3", 99, [0.15, 0.30], 0.12),
        ("T-1", 99, [0.30], 0.02), ("T-2", 99, [0.15], 0.02),
    ],
)  # fmt: skip
def test_limit_learns_from_other_tails(renewals, tail, flight, levels, loss):
    """A flight knows the failures of the months before its own."""
    by = passage_by_hand(levels, loss)
    row = renewals.row(by_predicate=pl.col("flight_id") == f"{tail}_{flight:03d}", named=True)
    assert row["p_event_100"] == pytest.approx(by[0, 10])
    life = [row["rul_low"], row["rul_flights"], row["rul_high"]]
    assert life == pytest.approx([quantile(by, level)[0] for level in (0.05, 0.5, 0.95)])
    assert row["beyond_horizon"] == (row["rul_flights"] >= 300.0)


def test_each_month_has_its_version(renewals):
    months = renewals.filter(tail="T-3").group_by(pl.col("departed_at").dt.month())
    versions = months.agg(pl.col("model_version").unique())
    assert versions["model_version"].list.len().to_list() == [1] * 4
    assert versions["model_version"].explode().n_unique() == 4


def test_component_choices_follow_prognosis():
    rows = pl.concat([make_features(40, "T-1", 0.24), make_features(70, "T-2", 0.1)])
    inputs = (rows, faults_on((0, HX_CODE)), log(), CC)

    choices = component_choices(*inputs, NO_WASHES).sort("tail", "choice")

    last = component_prognoses(*inputs).filter(pl.col("departed_at") == pl.col("departed_at").max().over("tail"))
    assert choices["choice"].to_list() == ["defer", "replace"] * 2
    assert choices["p_event_200"][::2].to_list() == pytest.approx(last.sort("tail")["p_event_200"].to_list())
    assert choices["p_event_200"][1] < choices["p_event_200"][0] / 10.0


def test_unreported_unit_may_have_failed():
    """Where nobody would tell: no message at all, or none of this component."""
    rows = make_features(40, "T-1", 0.24)
    silent, with_messages, mute = (
        component_prognoses(rows, messages, log(), part)["p_event_50"][-1]
        for messages, part in (
            (faults_on(), CC), (faults_on((0, HX_CODE)), CC), (faults_on((0, HX_CODE)), replace(CC, message_code=None)),
        )
    )  # fmt: skip
    assert silent == mute > with_messages


def test_unknown_loss_has_no_prognosis():
    rows = make_features(40, "T-1", 0.24).with_columns(loss=pl.lit(None, pl.Float64))
    unknown = component_prognoses(rows, faults_on(), log(), CC)
    assert unknown.select("rul_flights", "p_event_50").row(0) == (None, None)


def margin(n: int) -> dict[str, object]:
    """Curves that fall by 0.03 a kelvin, the half's by 0.1 below the fifth's; a loss too unsure to contradict a log."""
    excess = (-20.0, -10.0, 0.0, 5.0, 10.0)
    return {name: -0.5 - 0.1 * (k // 5) - 0.03 * excess[k % 5] for k, name in enumerate(CRITICAL)} | {
        "hx_fouling": [0.1 + 0.001 * k for k in range(n)], "hx_fouling_sd": 0.2, "hx_ln_ua_ratio": -0.1,
        "overheat_p20_k": [float(k % 9) for k in range(n)], "overheat_p50_k": 0.0, "full_open_share": 0.2,
    }  # fmt: skip


GAPS = pl.when(pl.int_range(100).is_in([0, 5])).then(None).otherwise("hx_fouling")
WITH_GAPS = fly(100, **margin(100)).with_columns(GAPS.alias("hx_fouling"))
THIRD_RULE = MessageRule(0.2, 7.0, 2.5, 3)
RESERVE = FEATURES.index("reserve_95")


@pytest.fixture(scope="module")
def track() -> Tracks:
    """Of flights two of which have no loss."""
    return tracks(WITH_GAPS, episodes(WITH_GAPS, faults_on((50, HX_CODE)), log(CHANGED)), "HX")


def test_tracks_are_cut_into_lives(track):
    assert track.at[:, 0].tolist() == [0] * 60 + [1] * 40
    assert track.at[[0, 1, 4, 5, 6, 59, 60], 1].tolist() == [-1, 0, 3, 3, 4, 57, 0]
    assert track.remaining[[0, 60]].tolist() == [50.0, 40.0]
    assert not track.mute.any()


def test_panel_has_the_known_flights(track):
    assert track.panel.level[0, 4] == pytest.approx(0.106)
    assert track.panel.age[1, 7] == 7.0
    assert np.isnan(track.panel.age[0]).all()
    assert track.panel.day[0, 0] == 2.0


def settled_losses(loss: list[float], sd: list[float]) -> list[float]:
    """Losses that forecasts of a sole unit are made of."""
    rows = fly(len(loss), hx_fouling=loss, hx_fouling_sd=sd, hx_ln_ua_ratio=-0.1)
    return tracks(rows, episodes(rows, faults_on(), log()), "HX").panel.level[0].tolist()


@pytest.mark.parametrize(("fallen", "stands"), [(0.09, 0.09), (0.11, 0.3)])
def test_loss_stands_while_fall_is_in_doubt(fallen, stands):
    """One flight's fall lies beyond two of its standard deviations, or within them: a faulty reading."""
    assert settled_losses([0.3, fallen, 0.3], [0.01, 0.1, 0.01]) == pytest.approx([0.3, stands, 0.3])


def test_long_doubt_ends():
    """A fall that lasts for more than three flights counts, however unsure each is."""
    assert settled_losses([0.3] + [0.2] * 5, [0.01] + [0.1] * 5) == pytest.approx([0.3] * 4 + [0.2] * 2)


def test_curves_fall_by_kelvin(track):
    np.testing.assert_allclose(track.curves[0, 3, 1], [0.0, -0.3, -0.6, -0.75, -0.9])


def test_rows_follow_operators_rule(track):
    """The half's curve at 2 K; three neighbouring kelvins say how steep."""
    features = fleet_rows(track, {"": THIRD_RULE, "AAA": MessageRule(0.5, 2.0, 1.5, 1)}).features
    assert np.isnan(features[0]).all()
    assert features[99, RESERVE] == pytest.approx(-0.1 - (-0.6 - 0.06))
    assert features[99, -1] == pytest.approx(1.5 * 0.03)


def test_rows_fall_back_to_fleets_rule(track):
    rows = fleet_rows(track, {"": THIRD_RULE}, np.arange(100) >= 98)
    assert rows.features.shape[0] == 2
    assert rows.features[1, -1] == pytest.approx(2.5 * 0.03)
    assert rows.remaining.tolist()[1:] == [1.0]


def test_rows_follow_declared_limit(track):
    features = fleet_rows(track, Limit(0.38, 0.06, 0.05)).features
    assert features[99, -1] == pytest.approx(0.06 / 0.62)
    assert features[99, RESERVE] == pytest.approx(-0.1 - np.log(0.62))


def test_rows_without_curves_take_usual_slope():
    none = WITH_GAPS.with_columns(pl.lit(None, pl.Float64).alias(c) for c in CRITICAL)
    blank = fleet_rows(tracks(none, episodes(WITH_GAPS, faults_on(), log()), "HX"), {"": MessageRule()})
    assert blank.features[99, -1] == pytest.approx(2.5 * LN_RATIO_PER_K)


@pytest.mark.parametrize(("life", "n_messages"), [(None, 1), (1, 0)])
def test_rule_learns_from_messages_of_lives(life, n_messages):
    """Hot on flights 7, 8 of nine: two in a row first at 8 K on flight 8; after its message a unit tells nothing."""
    features = fly(100, **margin(100))
    track = tracks(features, episodes(features, faults_on((17, HX_CODE)), log((20, "HX", "REPLACED", ""))), "HX")
    use = np.ones(100, bool) if life is None else track.at[:, 0] == life
    assert learn_rule(track, "HX", use)["AAA"].messages == n_messages


@pytest.mark.parametrize("message", [17, 0])
def test_rule_ignores_flights_after_message(message):
    """What is hot after it, until the unit is replaced, is no evidence."""
    features = fly(100, **margin(100))
    hot = pl.int_range(100).is_between(message + 1, message + 3)
    hotter = features.with_columns(overheat_p20_k=pl.when(hot).then(15.0).otherwise("overheat_p20_k"))
    ended = episodes(features, faults_on((message, HX_CODE)), log((message + 3, "HX", "REPLACED", "")))
    warm, plain = (learn_rule(tracks(f, ended, "HX"), "HX", np.ones(100, bool)) for f in (hotter, features))
    assert warm == plain


def test_simulated_rows_take_twentieth_flights():
    rows = simulated_rows(3, fleets=2, aircraft=2, flights=60)
    n = 0
    begins = np.random.default_rng(4)
    for lives, doubt in draw_fleets(3, 2, 2, 60):
        left, failed = lives.remaining()
        first = (-begins.integers(0, 20, len(left))) % 20
        for unit, start in enumerate(first):
            flights = [k for k in range(start, 60, 20) if left[unit, k] >= 1]
            own = rows.life == n + unit
            assert rows.remaining[own].tolist() == left[unit, flights].tolist()
            assert rows.failed[own].tolist() == failed[unit, flights].tolist()
            assert (rows.features[own, -1] == doubt).all()
        n += len(left)


@pytest.fixture(scope="module")
def compressor_track() -> Tracks:
    features = fly(60, cc_efficiency_loss=[None] + [0.01 * k for k in range(1, 60)], cc_efficiency_loss_sd=0.02,
                   cc_diameter_loss=0.1)  # fmt: skip
    return tracks(features, episodes(features, faults_on((20, CC_CODE)), log((24, "CC", "REPLACED", ""))), "CC")


def test_compressor_track_prefers_efficiency(compressor_track):
    """Else the square of what is left of the diameter."""
    np.testing.assert_allclose(compressor_track.panel.level[0, :3], [1.0 - 0.9**2, 0.01, 0.02])
    np.testing.assert_allclose(compressor_track.panel.ratio[0, :3], np.log([0.81, 0.99, 0.98]))


def test_compressor_rule_is_declared_limit(compressor_track):
    assert learn_rule(compressor_track, "CC", np.ones(60, bool)) == Limit(0.25, 0.06, 0.05)
