"""The benchmark's own arithmetic, on cases whose answer is known."""

import numpy as np
import polars as pl
import pytest

from benchmarks.alerts import ALERT_GOALS, alert_figures, low_margin_rightly
from benchmarks.augment import SHORTEST, augmented
from benchmarks.contestants import lead_at_budget
from benchmarks.federated import averaged_rule
from benchmarks.fleets import HELD_LOSS, loss_at_message, sound_seeds
from hdt_core.margin.exchanger_demand import EXCESS_K, SHARES, critical_name
from hdt_core.margin.margin import PRIOR_RULE, MessageRule
from hdt_core.prognosis.history import FEATURES
from hdt_core.simulate.design import draw_design


def life(number: int, flights: int, risk: np.ndarray, loss: np.ndarray, failed: bool = True) -> pl.DataFrame:
    k = np.arange(flights)
    return pl.DataFrame(
        {"tail": f"T{number}", "pack": 1, "life": number, "index": k, "risk": risk, "loss": loss, "failed": failed}
    ).with_columns(left=pl.Series((flights - k).astype(float)), flight_id=pl.format("T{}_{}", pl.lit(number), "index"))


def test_a_risk_that_knows_the_loss_alerts_where_the_budget_ends():
    loss = np.linspace(0.0, 0.4, 401)
    said = pl.concat([life(n, 401, loss, loss) for n in range(4)])
    median, tenth, early = lead_at_budget(said, early_per_1000=0.0)
    assert early == 0.0
    assert median == tenth
    # with no early alert allowed the best threshold is 15 % itself, 251 flights before the end
    assert median == pytest.approx(250, abs=8)


def test_a_risk_that_knows_nothing_gives_no_lead_within_the_budget():
    loss = np.linspace(0.0, 0.4, 401)
    noise = np.random.default_rng(0).random((4, 401))
    said = pl.concat([life(n, 401, noise[n], loss) for n in range(4)])
    informed = pl.concat([life(n, 401, loss, loss) for n in range(4)])
    assert lead_at_budget(said)[0] < 0.7 * lead_at_budget(informed)[0]


def test_figures_of_a_tally_by_hand():
    rows = [("a", "flights", 500.0), ("b", "flights", 500.0), ("a", "early", 1.0), ("b", "early", 1.0)]
    rows += [("a", "lead_HX", 100.0), ("b", "lead_HX", 0.0), ("a", "found_HX", 1.0), ("b", "found_HX", 0.0)]
    counted = pl.DataFrame(rows, schema=["tail", "what", "value"], orient="row")
    found = dict(zip(ALERT_GOALS, alert_figures(counted), strict=True))
    assert found["exchanger failures alerted before the message"] == 0.5
    assert found["lead, median [flights]"] == 50.0
    assert found["alerts below 15 % loss in 1,000 flights"] == 2.0
    assert found["false alarms in 1,000 flights"] == 0.0


def test_fleets_that_score_are_soundly_sized():
    for seed in sound_seeds(9000, 3):
        design = draw_design(np.random.default_rng(seed))
        assert loss_at_message(design, 0.0) > HELD_LOSS
        assert loss_at_message(design, 20.0) <= loss_at_message(design, 0.0)


def test_a_fault_laid_over_a_nominal_stretch_keeps_its_noise_and_fails_where_flights_ask_for_more():
    flights = SHORTEST + 20
    when = pl.datetime_range(pl.datetime(2024, 1, 1), pl.datetime(2025, 1, 1), "12h", time_unit="us", eager=True)[
        :flights
    ]
    key = {"operator": "X", "tail": "T1", "pack": pl.Series([1] * flights, dtype=pl.Int32), "departed_at": when}
    noise = 0.01 * np.random.default_rng(0).standard_normal(flights)
    features = pl.DataFrame(key | {"flight_id": [f"T1_{k}" for k in range(flights)], "hx_fouling": noise})
    # every flight asks for a ln ratio of -0.4 at the 7 K of the rule before any message
    asks = {critical_name(share, e): pl.lit(-0.4 - 0.02 * (e - 7.0)) for share in SHARES for e in EXCESS_K}
    seen = {"overheat_p20_k": pl.lit(0.0), "overheat_p50_k": pl.lit(0.0), "full_open_share": pl.lit(0.0)}
    features = features.with_columns(hx_fouling_sd=pl.lit(0.01), hx_ln_ua_ratio=-pl.col("hx_fouling"), **asks, **seen)
    lives = pl.DataFrame(
        {"operator": ["X"], "tail": ["T1"], "pack": pl.Series([1], dtype=pl.Int32), "component": ["HX"], "life": [0]}
        | {"first_row": [0], "end_row": [flights], "failed": [False], "age_known": [False], "mute": [False]}
    )
    made = augmented(features, lives)
    laid = made.frame["tail"].str.starts_with("laid over").to_numpy()
    assert (~laid).sum() == flights
    level, overheat_k = (made.inputs["health"][:, FEATURES.index(n)] for n in ("level", "overheat_most_40"))
    last = laid & made.failed & (made.left == 1)
    assert last.sum() >= 3
    assert np.median(level[last]) == pytest.approx(1.0 - np.exp(-0.4), abs=0.03)
    assert np.median(overheat_k[last]) == pytest.approx(7.0, abs=1.0)
    young = laid & (made.inputs["health"][:, FEATURES.index("age_flights")] == 20.0)
    assert np.median(overheat_k[young]) == 0.0
    assert not made.failed[~laid].any()


def test_rules_of_operators_average_by_precision_with_the_prior_counted_once():
    share, prior = PRIOR_RULE.share, PRIOR_RULE
    own = MessageRule(share, 9.0, 1.0, prior.of, 4)
    untold = MessageRule(share, prior.excess_k, prior.excess_sd_k, prior.of, 0)
    alone = averaged_rule([own, untold, untold])
    assert (alone.excess_k, alone.excess_sd_k) == pytest.approx((9.0, 1.0))
    assert averaged_rule([untold, untold]).excess_sd_k == pytest.approx(prior.excess_sd_k)
    twice = averaged_rule([own, own])
    assert 9.0 < twice.excess_k < 10.0
    assert twice.excess_sd_k < 1.0
    assert twice.messages == 8


def test_share_and_persistence_are_those_that_most_messages_speak_for():
    few, many = MessageRule(0.2, 5.0, 1.0, 3, 1), MessageRule(0.5, 9.0, 1.0, 1, 6)
    assert averaged_rule([few, many]) == MessageRule(0.5, pytest.approx(9.0), pytest.approx(1.0), 1, 7)


def test_an_alert_of_low_margin_is_right_when_the_message_comes_soon():
    at = {"tail": ["a", "a", "a", "b"], "pack": [1, 1, 1, 1], "index": [100, 500, 100, 100]}
    alerts = pl.DataFrame(at | {"diagnosis": ["HX_LOW_MARGIN", "HX_LOW_MARGIN", "HX_FOULING", "HX_LOW_MARGIN"]})
    ended = {"tail": ["a", "b"], "pack": [1, 1], "component": ["HX", "HX"], "message_index": [300, None]}
    assert low_margin_rightly(alerts, pl.DataFrame(ended)).to_list() == [True, False, False, False]
