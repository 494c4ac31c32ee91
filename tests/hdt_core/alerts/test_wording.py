"""The numbers of the evidence, from the facts of a moment."""

from dataclasses import MISSING, fields

import pytest
from scipy.stats import norm

from hdt_core.alerts import evidence
from hdt_core.alerts.cases import FAILS_AT
from hdt_core.alerts.diagnoses import DIAGNOSES, compressor, exchanger, low_margin, ram_door, sensor
from hdt_core.alerts.diagnoses.compressor import CompressorFacts
from hdt_core.alerts.diagnoses.exchanger import ExchangerFacts
from hdt_core.alerts.diagnoses.low_margin import MarginFacts
from hdt_core.alerts.diagnoses.ram_door import DoorFacts
from hdt_core.alerts.diagnoses.sensor import SensorFacts
from hdt_core.alerts.evidence import Evidence
from hdt_core.alerts.facts import Facts

NAN = float("nan")
WORN = {
    "hx_fouling": 0.25, "hx_fouling_sd": 0.02, "hx_fouling_slope_30_per_flight": 0.0021, "gained": 0.28, "jump": 0.123,
    "door_full_open_share": 0.3, "door_median_between_packs": 0.08, "hx_fouling_between_packs": 0.1,
    "ram_flow_loss": 0.06,
}  # fmt: skip


def record_of(record: type[Facts], facts: dict):
    """A record of which nothing else is known."""
    needed = (f.name for f in fields(record) if f.default is MISSING)
    return record(**(dict.fromkeys(needed, NAN) | facts))


def fouling_evidence(rule=exchanger.exchanger, **changed: object) -> Evidence:
    return rule(record_of(ExchangerFacts, WORN | changed), "F07")


@pytest.mark.parametrize(
    ("rule", "changed", "words"),
    [
        # 90 % interval: 1.645 deviations on either side
        (
            exchanger.exchanger,
            {},
            "(hx_fouling) 25 % (22 to 28), 12 times its uncertainty; above 5 % since F07, and with",
        ),
        (exchanger.exchanger, {}, "probability above 0.99"),
        (exchanger.exchanger, {"hx_fouling": 0.07}, f"with probability {norm.cdf(1.0):.2f}"),
        (exchanger.exchanger, {}, "; 2.1 points more every ten flights"),
        (exchanger.exchanger, {"gained": 0.296}, "its last ten flights alone lost 30 points more"),
        (exchanger.clog, {}, "12 points of it within three flights"),
    ],
)
def test_fouling_evidence_states_figures(rule, changed, words):
    assert words in fouling_evidence(rule, **changed).text()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "its last ten flights"), ({"hx_fouling_slope_30_per_flight": 9e-6}, "points more every"),
        ({"hx_fouling_between_packs": 0.05}, "wider"), ({"hx_fouling_between_packs": 0.05}, "as wide"),
        ({"door_median_between_packs": NAN}, "wider"), ({"door_median_between_packs": NAN}, "as wide"),
    ],
)  # fmt: skip
def test_fouling_evidence_omits_small_differences(changed, words):
    assert words not in fouling_evidence(**changed).text()


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
    assert [w.role for w in fouling_evidence(**changed).corroborations if words in w.text] == [role]


def test_lone_pack_has_one_witness():
    assert len(fouling_evidence(hx_fouling_between_packs=NAN, ram_flow_loss=NAN).corroborations) == 1


def test_intervals_are_in_percent():
    assert evidence.within(0.34, 0.01) == "34 % (32 to 36)"
    assert evidence.within(0.3, 0.02, 1) == "30.0 % (26.7 to 33.3)"


@pytest.mark.parametrize(
    ("value", "sd", "chance"),
    [(0.16, 0.01, "0.84"), (0.2, 0.01, "above 0.99"), (0.2, 0.0, "above 0.99"), (0.1, 0.05, f"{norm.cdf(-1.0):.2f}")],
)
def test_chances_are_in_hundredths(value, sd, chance):
    assert evidence.chance_above(value, 0.15, sd) == chance


FEW = (FAILS_AT - 0.2) / 49.0
"""Loss a flight of an exchanger that fails in forty-nine flights."""
CALM = {"hx_fouling": 0.2, "hx_fouling_slope_30_per_flight": 0.0}


@pytest.mark.parametrize(
    ("changed", "severity"),
    [
        ({}, "medium"), ({"hx_fouling": 0.301}, "high"), ({"hx_fouling": 0.3}, "medium"),
        ({"hx_fouling_slope_30_per_flight": FEW}, "high"),
        ({"hx_fouling_slope_30_per_flight": FEW * 49.0 / 51.0}, "medium"),
    ],
)  # fmt: skip
def test_exchanger_severity_changes_at_edge(changed, severity):
    assert exchanger.exchanger_severity(record_of(ExchangerFacts, CALM | changed)) == severity


@pytest.mark.parametrize(
    ("changed", "flights"),
    [
        ({"hx_fouling": 0.9, "hx_fouling_slope_30_per_flight": 0.1}, 0.0),
        ({"hx_fouling_slope_30_per_flight": 1e-5}, None),
    ],
)
def test_flights_left_follow_trend(changed, flights):
    assert exchanger.flights_left(record_of(ExchangerFacts, CALM | changed)) == flights


@pytest.mark.parametrize(
    ("code", "record", "facts", "severity"),
    [
        ("HX_LOW_MARGIN", MarginFacts, {"hx_passage_100": 0.5}, "medium"),
        ("HX_LOW_MARGIN", MarginFacts, {"hx_passage_100": 0.51}, "high"),
        ("RAM_DOOR_FAULT", DoorFacts, {"kind": "jam"}, "high"),
        ("RAM_DOOR_FAULT", DoorFacts, {"kind": "lost travel"}, "medium"),
    ],
)
def test_severity_changes_at_edge(code, record, facts, severity):
    assert DIAGNOSES[code].severity(record_of(record, facts)) == severity


@pytest.mark.parametrize(
    ("facts", "severity"),
    [
        ({"kind": "shift", "sensor": "hx_out_k"}, "medium"), ({"kind": "shift", "sensor": "mach"}, "low"),
        ({"kind": "contradicted"}, "medium"),
    ],
)  # fmt: skip
def test_sensor_severity_follows_use(facts, severity):
    """Medium for a sensor that the health estimate depends on."""
    assert sensor.sensor_severity(record_of(SensorFacts, facts)) == severity


LITTLE = WORN | {
    "hx_margin_k": -2.4, "hx_margin_hot_day_k": 3.6, "hx_passage_300": 0.93, "hx_margin_design_k": 6.4,
    "hx_margin_target_k": NAN, "hx_margin_flow_k": -1.6, "hx_margin_ambient_k": -8.0, "hx_margin_wear_k": 0.0,
    "overheat_p20_k": 1.1,
}  # fmt: skip


def margin_text(**changed: float) -> str:
    return low_margin.low_margin(record_of(MarginFacts, LITTLE | changed), "F07").text()


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({}, "2 K above its level"), ({}, "4 K below it on a hot day"), ({}, "probability 0.93"),
        ({}, "the design gives +6 K, flow -2 K, air"), ({}, "air outside -8 K, wear and build +0 K"),
        ({}, "outlet was 1 K above its level"), ({"hx_margin_k": NAN}, "unknown distance"),
        ({"hx_margin_k": 0.0}, "0 K below"),
    ],
)  # fmt: skip
def test_low_margin_evidence_states_figures(changed, words):
    assert words in margin_text(**changed)


def test_cool_outlet_goes_unmentioned():
    assert "outlet was" not in margin_text(overheat_p20_k=1.0)


SHRUNK = {
    "cc_efficiency_loss": 0.082, "cc_efficiency_loss_sd": 0.01, "shrunk": -0.044, "cc_diameter_loss": 0.0206,
    "cc_diameter_left": 0.034, "cc_diameter_left_hot_high": -0.026,
}  # fmt: skip


def compressor_evidence(**changed: float) -> Evidence:
    return compressor.compressor(record_of(CompressorFacts, SHRUNK | changed), "F07")


@pytest.mark.parametrize(
    ("loss", "words"),
    [
        (
            0.082,
            "8.2 % (6.6 to 9.8) against expectation, 8 times its uncertainty, likely since F07; worn at all (above",
        ),
        (0.082, "worn at all (above 5 %)"),
        (NAN, "is 4.4 % below this unit's own first flights, 2.0 times the scatter of a flight"),
    ],
)
def test_compressor_evidence_states_figures(loss, words):
    assert words in compressor_evidence(cc_efficiency_loss=loss).findings[0]


SHORT = {"cc_diameter_left": -0.02, "cc_diameter_left_hot_high": 0.01}
"""Too small for its flights, not for those hot and high."""


@pytest.mark.parametrize(
    ("changed", "witness", "words"),
    [
        ({}, 1, "3 % more of it"), ({}, 2, "it is 3 % too small"), (SHORT, 1, "2 % too small"),
        (SHORT, 2, "1 % may go"),
    ],
)  # fmt: skip
def test_compressor_witnesses_state_figures(changed, witness, words):
    assert words in compressor_evidence(**changed).corroborations[witness].text


def test_compressor_witness_names_diameter():
    assert compressor_evidence().corroborations[0].text.startswith("effective diameter lost (cc_diameter_loss) 2.1 %")


@pytest.mark.parametrize(
    ("loss", "role"), [(0.0206, "Supports"), (0.0204, "Neutral"), (-0.0219, "Neutral"), (-0.0221, "Against")]
)
def test_diameter_role_changes_at_edge(loss, role):
    assert compressor_evidence(cc_diameter_loss=loss).corroborations[0].role == role


def test_small_diameter_supports_wear():
    assert [w.role for w in compressor_evidence(**SHORT).corroborations[1:]] == ["Supports", "Neutral"]


@pytest.mark.parametrize(("unknown", "n_witnesses"), [("cc_diameter_loss", 0), ("cc_diameter_left", 1)])
def test_unknown_diameter_is_no_witness(unknown, n_witnesses):
    assert len(compressor_evidence(**{unknown: NAN}).corroborations) == n_witnesses


@pytest.mark.parametrize(("whose", "is_held_back"), [("own", False), ("both", True)])
def test_common_change_points_to_map(whose, is_held_back):
    facts = {"kind": "shift", "sensor": "pack_flow_kg_s", "whose": whose}

    addendum = sensor.sensor_addendum(record_of(SensorFacts, facts))

    assert ("look at the recorder's scale, map and software first" in "".join(addendum)) == is_held_back


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        (
            {"kind": "lost travel", "stop": 0.42, "excess_k": 2.0},
            "no further than 42 %: since F07 the outlet ran up to 2.0 K (6 times the scatter",
        ),
        ({"kind": "jam", "stop": 0.42}, "stays at 42 %"),
    ],
    ids=["lost travel", "jam"],
)
def test_door_evidence_states_figures(facts, words):
    assert words in ram_door.door(record_of(DoorFacts, facts), "F07").text()


SHIFT = {"kind": "shift", "sensor": "hx_out_k", "sigma": 7.25, "p": 0.973}
BY_K = SHIFT | {"channel": "hx_out_between_packs_k", "moved": -3.456}


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        (BY_K, "moved by -3.46 K (7.2 times its uncertainty"),
        (BY_K, "with probability 0.97"),
        (SHIFT | {"channel": "pack_over_compressor_flow_ln", "moved": 0.0712}, "moved by +7.1 %"),
        (
            {"kind": "dropout", "sensor": "mach", "share": 0.25},
            "Mach number (mach) is empty in 25 % of its readings since F07",
        ),
        (
            {"kind": "contradicted", "of": "HX", "looked_on": "2024-03-01", "level": 0.2, "loss": 0.24},
            "at a loss of 20 %, and the loss has grown to 24 %",
        ),
    ],
    ids=["kelvin", "probability", "percent", "dropout", "contradicted"],
)
def test_sensor_evidence_states_figures(facts, words):
    assert words in sensor.sensor(record_of(SensorFacts, facts), "F07").text()
