"""The numbers of the evidence, from the facts of a moment."""

from dataclasses import MISSING, fields

import numpy as np
import pytest
from scipy.stats import norm

from hdt_core.alerts import evidence as wording
from hdt_core.alerts.cases import FAILS_AT
from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.facts import CompressorFacts, DoorFacts, ExchangerFacts, Facts, MarginFacts, SensorFacts

NAN = float("nan")
WORN = {
    "hx_fouling": 0.25, "hx_fouling_sd": 0.02, "hx_fouling_slope_30_per_flight": 0.0021, "gained": 0.28, "jump": 0.123,
    "door_full_open_share": 0.3, "door_median_between_packs": 0.08, "hx_fouling_between_packs": 0.1,
    "ram_flow_loss": 0.06,
}  # fmt: skip


def of(record: type[Facts], known: dict):
    """A record of which nothing else is known."""
    needed = (f.name for f in fields(record) if f.default is MISSING)
    return record(**(dict.fromkeys(needed, NAN) | known))


def text(rule, **changed: object) -> str:
    return rule(of(ExchangerFacts, WORN | changed), "F07").text()


def test_fouling_evidence_states_figures():
    message = text(wording.exchanger)
    # 90 % interval: 1.645 deviations on either side
    assert "(hx_fouling) 25 % (22 to 28), 12 times its uncertainty; above 5 % since F07, and with" in message
    assert "probability above 0.99" in message
    assert "; 2.1 points more every ten flights" in message
    assert "its last ten flights" not in message
    assert "its last ten flights alone lost 30 points more" in text(wording.exchanger, gained=0.296)
    assert "points more every" not in text(wording.exchanger, hx_fouling_slope_30_per_flight=9e-6)
    assert "12 points of it within three flights" in text(wording.clog)
    sure = text(wording.exchanger, hx_fouling=0.07)
    assert f"with probability {norm.cdf(1.0):.2f}" in sure


@pytest.mark.parametrize(
    ("changed", "role", "words"),
    [
        ({"door_full_open_share": 0.049}, "Neutral", "full open in 5 % of cruise: it can"),
        ({"door_full_open_share": 0.05}, "Supports", "full open in 5 % of cruise"),
        ({"door_full_open_share": NAN}, "Neutral", "door position unknown"),
        ({"door_median_between_packs": 0.031}, "Supports", "3 points wider"),
        ({"door_median_between_packs": 0.029}, "Neutral", "about as wide"),
        ({"door_median_between_packs": -0.031}, "Against", "3 points narrower"),
        ({"hx_fouling_between_packs": 0.051}, "Supports", "5 points less"),
        ({"hx_fouling_between_packs": 0.05}, "Neutral", "lost as much"),
        ({"ram_flow_loss": 0.041}, "Supports", "ram flow 4 % below"),
        ({"ram_flow_loss": 0.04}, "Neutral", "no blockage"),
    ],
)
def test_witness_role_changes_at_edge(changed, role, words):
    witnesses = wording.exchanger(of(ExchangerFacts, WORN | changed), "F07").corroborations
    assert [w.role for w in witnesses if words in w.text] == [role]


def test_similar_packs_omit_door_comparison():
    for changed in ({"hx_fouling_between_packs": 0.05}, {"door_median_between_packs": NAN}):
        message = wording.exchanger(of(ExchangerFacts, WORN | changed), "F").text()
        assert "wider" not in message
        assert "as wide" not in message
    alone = wording.exchanger(
        of(ExchangerFacts, WORN | {"hx_fouling_between_packs": NAN, "ram_flow_loss": NAN}), "F"
    ).corroborations
    assert len(alone) == 1
    assert wording.within(0.34, 0.01) == "34 % (32 to 36)"
    assert wording.within(0.3, 0.02, 1) == "30.0 % (26.7 to 33.3)"
    assert wording.chance_above(0.16, 0.15, 0.01) == "0.84"
    assert wording.chance_above(0.2, 0.15, 0.01) == "above 0.99"
    assert wording.chance_above(0.2, 0.15, 0.0) == "above 0.99"
    assert np.isclose(float(wording.chance_above(0.1, 0.15, 0.05)), norm.cdf(-1.0), atol=0.005)


def test_severity_changes_at_edge():
    few = (FAILS_AT - 0.2) / 49.0
    base = {"hx_fouling": 0.2, "hx_fouling_slope_30_per_flight": 0.0}
    for changed, severity in (
        ({}, "medium"), ({"hx_fouling": 0.301}, "high"), ({"hx_fouling": 0.3}, "medium"),
        ({"hx_fouling_slope_30_per_flight": few}, "high"),
        ({"hx_fouling_slope_30_per_flight": few * 49.0 / 51.0}, "medium"),
    ):  # fmt: skip
        assert wording.exchanger_severity(of(ExchangerFacts, base | changed)) == severity
    assert (
        wording.flights_left(of(ExchangerFacts, base | {"hx_fouling": 0.9, "hx_fouling_slope_30_per_flight": 0.1}))
        == 0.0
    )
    assert wording.flights_left(of(ExchangerFacts, base | {"hx_fouling_slope_30_per_flight": 1e-5})) is None
    assert [DIAGNOSES["HX_LOW_MARGIN"].severity(of(MarginFacts, {"hx_passage_100": p})) for p in (0.5, 0.51)] == [
        "medium",
        "high",
    ]
    assert [DIAGNOSES["RAM_DOOR_FAULT"].severity(of(DoorFacts, {"kind": k})) for k in ("jam", "lost travel")] == [
        "high",
        "medium",
    ]
    kinds = [{"kind": "shift", "sensor": "hx_out_k"}, {"kind": "shift", "sensor": "mach"}, {"kind": "contradicted"}]
    assert [wording.sensor_severity(of(SensorFacts, k)) for k in kinds] == ["medium", "low", "medium"]


def test_low_margin_evidence_states_figures():
    facts = WORN | {
        "hx_margin_k": -2.4, "hx_margin_hot_day_k": 3.6, "hx_passage_300": 0.93, "hx_margin_design_k": 6.4,
        "hx_margin_target_k": NAN, "hx_margin_flow_k": -1.6, "hx_margin_ambient_k": -8.0, "hx_margin_wear_k": 0.0,
        "overheat_p20_k": 1.1,
    }  # fmt: skip
    message = wording.low_margin(of(MarginFacts, facts), "F07").text()
    for words in (
        "2 K above its level", "4 K below it on a hot day", "probability 0.93", "the design gives +6 K, flow -2 K, air",
        "air outside -8 K, wear and build +0 K", "outlet was 1 K above its level",
    ):  # fmt: skip
        assert words in message
    cool = wording.low_margin(of(MarginFacts, facts | {"overheat_p20_k": 1.0, "hx_margin_k": NAN}), "F07").text()
    assert "outlet was" not in cool
    assert "unknown distance" in cool
    assert "0 K below" in wording.low_margin(of(MarginFacts, facts | {"hx_margin_k": 0.0}), "F07").text()


def test_compressor_evidence_states_figures():
    facts = {
        "cc_efficiency_loss": 0.082, "cc_efficiency_loss_sd": 0.01, "shrunk": -0.044, "cc_diameter_loss": 0.0206,
        "cc_diameter_left": 0.034, "cc_diameter_left_hot_high": -0.026,
    }  # fmt: skip
    evidence = wording.compressor(of(CompressorFacts, facts), "F07")
    assert (
        "8.2 % (6.6 to 9.8) against expectation, 8 times its uncertainty, likely since F07; worn at all (above 5 %)"
        in evidence.finding
    )
    roles = [(w.role, w.text[:40]) for w in evidence.corroborations]
    assert roles[0] == ("Supports", "effective diameter lost (cc_diameter_los")
    assert "lost (cc_diameter_loss) 2.1 %" in evidence.corroborations[0].text
    assert "3 % more of it" in evidence.corroborations[1].text
    assert "it is 3 % too small" in evidence.corroborations[2].text
    for loss, role in ((0.0204, "Neutral"), (-0.0219, "Neutral"), (-0.0221, "Against")):
        assert (
            wording.compressor(of(CompressorFacts, facts | {"cc_diameter_loss": loss}), "F").corroborations[0].role
            == role
        )
    left = {"cc_diameter_left": -0.02, "cc_diameter_left_hot_high": 0.01}
    short = wording.compressor(of(CompressorFacts, facts | left), "F").corroborations
    assert (short[1].role, short[2].role) == ("Supports", "Neutral")
    assert "2 % too small" in short[1].text
    assert "1 % may go" in short[2].text
    silent = wording.compressor(of(CompressorFacts, facts | {"cc_efficiency_loss": NAN}), "F07")
    assert "is 4.4 % below this unit's own first flights, 2.0 times the scatter of a flight" in silent.finding
    assert wording.compressor(of(CompressorFacts, facts | {"cc_diameter_loss": NAN}), "F").corroborations == ()
    assert len(wording.compressor(of(CompressorFacts, facts | {"cc_diameter_left": NAN}), "F").corroborations) == 1


@pytest.mark.parametrize(("whose", "is_held_back"), [("own", False), ("both", True)])
def test_common_change_points_to_map(whose, is_held_back):
    facts = {"kind": "shift", "sensor": "pack_flow_kg_s", "whose": whose}

    assert (
        "look at the recorder's scale, map and software first" in wording.sensor_addendum(of(SensorFacts, facts))
    ) == is_held_back


def test_door_evidence_states_figures():
    door = wording.door(of(DoorFacts, {"kind": "lost travel", "stop": 0.42, "excess_k": 2.0}), "F07").text()
    assert "no further than 42 %: since F07 the outlet ran up to 2.0 K (6 times the scatter" in door
    assert "stays at 42 %" in wording.door(of(DoorFacts, {"kind": "jam", "stop": 0.42}), "F07").text()
    shift = {"kind": "shift", "sensor": "hx_out_k", "sigma": 7.25, "p": 0.973}
    by_k = wording.sensor(of(SensorFacts, shift | {"channel": "hx_out_between_packs_k", "moved": -3.456}), "F07").text()
    assert "moved by -3.46 K (7.2 times its uncertainty" in by_k
    assert "with probability 0.97" in by_k
    by_ln = wording.sensor(
        of(SensorFacts, shift | {"channel": "pack_over_compressor_flow_ln", "moved": 0.0712}), "F07"
    ).text()
    assert "moved by +7.1 %" in by_ln
    empty = wording.sensor(of(SensorFacts, {"kind": "dropout", "sensor": "mach", "share": 0.25}), "F07").text()
    assert "Mach number (mach) is empty in 25 % of its readings since F07" in empty
    back = {"kind": "contradicted", "of": "HX", "looked_on": "2024-03-01", "level": 0.2, "loss": 0.24}
    assert "at a loss of 20 %, and the loss has grown to 24 %" in wording.sensor(of(SensorFacts, back), "F07").text()
