"""Evidence of each diagnosis: what changed and since when, observations for and against it, the cost of waiting."""

import json
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from scipy.special import ndtr

from hdt_core.alerts import phrases
from hdt_core.alerts.cases import DIAMETER_SD, FAILS_AT, WEAR_LIMIT, Limits
from hdt_core.alerts.facts import (
    CompressorFacts,
    DoorFacts,
    ExchangerFacts,
    LossFacts,
    MarginFacts,
    SensorFacts,
)
from hdt_core.alerts.fault_isolation import is_of_both_packs
from hdt_core.alerts.text import Column, Figures, Text, TextList, as_parts
from hdt_core.components import Component
from hdt_core.robust import Z_90

SUPPORTS, NEUTRAL, AGAINST = ROLES = ("Supports", "Neutral", "Against")
ELSE = "Else"


class Corroboration(NamedTuple):
    """An independent observation that bears on an alert: its role (of `ROLES`) and its text."""

    role: str
    text: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of an alert at one moment.

    Attributes
    ----------
    findings : tuple of str
        What changed, by how much, since when.
    corroborations : tuple of Corroboration
        Other observations, each with its role.
    otherwise : str
        Other explanations.
    waiting : str
        Cost of waiting.
    """

    findings: tuple[str, ...]
    corroborations: tuple[Corroboration, ...]
    otherwise: str
    waiting: str

    def sections(self) -> list[tuple[str, TextList]]:
        """Return the findings, their corroborations by role, the alternatives and the cost, each with its label."""
        by_role = ((role, [w.text for w in self.corroborations if w.role == role]) for role in ROLES)
        of_roles = [(role, texts) for role, texts in by_role if texts]
        sections = [("", list(self.findings)), *of_roles, (ELSE, [self.otherwise]), ("", [self.waiting])]
        return [(label, TextList(map(Text.whole, texts), "; ")) for label, texts in sections]

    def text(self) -> str:
        """Return one paragraph in English, a sentence a section."""
        return " ".join(f"{label}: {texts}." if label else f"{capitalised(texts)}." for label, texts in self.sections())

    def to_json(self) -> str:
        """Write the sections as a list of `{"label": ..., "texts": ...}`: see `text.as_parts`."""
        sections = [{"label": label, "texts": as_parts(texts)} for label, texts in self.sections()]
        return json.dumps(sections, ensure_ascii=False, separators=(",", ":"))


def capitalised(text: str) -> str:
    """Begin a sentence with a capital letter."""
    return text[:1].upper() + text[1:]


PEG_SD_K = 0.33
"""Scatter, over sound flights, of the outlet where the door is widest less the outlet elsewhere. [K]"""
ESTIMATE_SENSORS = ("hx_out_k", "hx_in_k", "pack_flow_kg_s", "tat_k")
"""Sensors that the fouling estimate depends on."""
CONTRADICTED = "contradicted"
"""Kind of a sensor case raised by an inspection of another part."""
FULL_OPEN_SHARE = 0.05
"""Share of cruise with the door full open that a sound pack shows on one flight in a hundred. [-]"""
DOOR_DIFFERENCE, LOSS_DIFFERENCE, RAM_FLOW_LOSS = 0.03, 0.05, 0.04
"""Differences beyond chance between packs of one aircraft, and against a clean duct: three standard deviations. [-]"""
HIGH_SEVERITY_SHARE = 0.8
"""Loss from which severity is high, as a share of the loss at which the component fails. [-]"""


def exchanger_severity(facts: ExchangerFacts) -> str:
    """Return high where failure is near."""
    flights = flights_left(facts)
    return "high" if facts.hx_fouling > 0.3 or (flights is not None and flights < 50) else "medium"


def sensor_severity(facts: SensorFacts) -> str:
    """Return medium for a sensor that the health estimate depends on."""
    return "medium" if facts.kind == CONTRADICTED or facts.sensor in ESTIMATE_SENSORS else "low"


def flights_left(facts: ExchangerFacts) -> float | None:
    """Extrapolate the flights to the loss at which packs fail, for the severity; None where the loss does not grow."""
    slope = facts.hx_fouling_slope_30_per_flight
    return max((FAILS_AT - facts.hx_fouling) / slope, 0.0) if slope > 1e-5 else None


def sensor_addendum(facts: SensorFacts) -> tuple[Text, ...]:
    """Return the sensor by what it measures; of a contradiction, what to compare."""
    if facts.kind == CONTRADICTED:
        return (Text(phrases.COMPARE, day=facts.looked_on),)
    phrase = phrases.BOTH_NAMED if _is_of_both_packs(facts) else phrases.SENSOR_NAMED
    return (Text(phrase, sensor=phrases.plain_name(facts.sensor)),)


def _is_of_both_packs(facts: SensorFacts) -> bool:
    return is_of_both_packs(facts.sensor, facts.whose)


def within(value: float, sd: float, digits: int = 0) -> str:
    """Format a share in per cent with its interval of 90 %.

    Examples
    --------
    >>> within(0.34, 0.01)
    '34 % (32 to 36)'
    """
    low, high = (_percent(value + side * Z_90 * sd, digits) for side in (-1, 1))
    return Text(phrases.WITHIN, value=_percent(value, digits), low=low, high=high)


def _percent(share: float, digits: int = 0) -> Figures:
    return _figures(100.0 * share, digits)


def _figures(value: float, digits: int = 0, unit: str = "") -> Figures:
    return Figures(f"{value:.{digits}f}", unit)


def _probability(p: float) -> str:
    """Format a probability, capped below certainty."""
    return Text(phrases.ABOVE, value=Figures("0.99")) if p > 0.99 else _figures(p, 2)


def chance_above(value: float, limit: float, sd: float) -> str:
    """Format the probability that the true value exceeds the limit."""
    return _probability(float(ndtr((value - limit) / max(sd, 1e-6))))


def loss_finding(phrase: str, loss: float, sd: float, limit: float, since: str, digits: int = 0, **names: str) -> Text:
    """Format a loss with its interval, its distance from 0, and the probability that it exceeds the limit."""
    return Text(
        phrase,
        loss=within(loss, sd, digits),
        sigma=_figures(loss / max(sd, 1e-6)),
        limit=_percent(limit),
        since=since,
        odds=chance_above(loss, limit, sd),
        **names,
    )


def trend(slope: float) -> list[Text]:
    """Format the growth of a loss over thirty flights; empty where it does not grow."""
    return [Text(phrases.TREND, points=_figures(1000.0 * slope, 1))] if slope > 1e-5 else []


def exchanger(facts: ExchangerFacts, since: str, clean_flow: str = NEUTRAL) -> Evidence:
    """Return the evidence of fouling; `clean_flow`: the role of a ram flow that is not reduced."""
    loss = facts.hx_fouling
    sd = facts.hx_fouling_sd
    findings = [loss_finding(phrases.UA_LOST, loss, sd, WEAR_LIMIT, since)]
    findings += trend(facts.hx_fouling_slope_30_per_flight)
    if facts.gained > loss + 2.0 * sd:
        findings.append(Text(phrases.RISE, points=_percent(facts.gained)))
    # a blockage starves the ram flow, a film does not; known where the ram outlet is measured
    ram_flow = graded(
        facts.ram_flow_loss,
        (RAM_FLOW_LOSS, SUPPORTS, phrases.FLOW_BLOCKED),
        (-math.inf, clean_flow, phrases.FLOW_CLEAN),
    )
    corroborations = (_full_open(facts), *_beside(facts), *ram_flow)
    return Evidence(tuple(findings), corroborations, phrases.EXCHANGER_ELSE, phrases.EXCHANGER_COSTS)


def clog(facts: ExchangerFacts, since: str) -> Evidence:
    """Return the evidence of a sudden clog: fouling with a jump too fast for wear."""
    fouling = exchanger(facts, since, AGAINST)
    jump = Text(phrases.JUMP, points=_percent(facts.jump))
    return replace(fouling, findings=(*fouling.findings, jump))


def graded(value: float, *grades: tuple[float, str, str]) -> tuple[Corroboration, ...]:
    """Return the observation of the first grade (limit, role, phrase) that the value exceeds; none where it is unknown.

    The phrase takes the value's size in per cent, as `share` or as `points`.
    """
    percent = _percent(abs(value))
    for limit, role, phrase in grades:
        if value > limit:
            return (Corroboration(role, Text(phrase, share=percent, points=percent)),)
    return ()


def _full_open(facts: ExchangerFacts) -> Corroboration:
    """Report whether the door is full open, so that the controller lacks ram air."""
    share = facts.door_full_open_share
    if math.isnan(share):
        return Corroboration(NEUTRAL, phrases.DOOR_UNKNOWN)
    role, phrase = (NEUTRAL, phrases.DOOR_SPARE) if share < FULL_OPEN_SHARE else (SUPPORTS, phrases.DOOR_FULL)
    return Corroboration(role, Text(phrase, share=_percent(share)))


def _beside(facts: ExchangerFacts) -> tuple[Corroboration, ...]:
    """Compare both packs: the door of that which lost more stands wider; a loss of both may have a common cause."""
    wider = facts.door_median_between_packs
    more = facts.hx_fouling_between_packs
    doors = graded(
        wider,
        (DOOR_DIFFERENCE, SUPPORTS, phrases.DOOR_WIDER),
        (-DOOR_DIFFERENCE, NEUTRAL, phrases.DOOR_ALIKE),
        (-math.inf, AGAINST, phrases.DOOR_NARROWER),
    )
    losses = graded(more, (LOSS_DIFFERENCE, SUPPORTS, phrases.OTHER_LESS), (-math.inf, NEUTRAL, phrases.OTHER_ALIKE))
    return (*doors, *losses) if more > LOSS_DIFFERENCE else losses


def low_margin(facts: MarginFacts, since: str) -> Evidence:
    """Return the evidence of little reserve before the message, with its parts."""
    finding = Text(
        phrases.MARGIN,
        margin=_kelvin(facts.hx_margin_k),
        hot_day=_kelvin(facts.hx_margin_hot_day_k),
        odds=_probability(facts.hx_passage_300),
        since=since,
    )
    parts = (
        (phrases.BY_DESIGN, facts.hx_margin_design_k),
        (phrases.BY_TARGET, facts.hx_margin_target_k),
        (phrases.BY_FLOW, facts.hx_margin_flow_k),
        (phrases.BY_AIR, facts.hx_margin_ambient_k),
        (phrases.BY_WEAR, facts.hx_margin_wear_k),
    )
    shares = TextList((Text(phrase, k=Figures(f"{k:+.0f}", "K")) for phrase, k in parts if not math.isnan(k)), ", ")
    corroborations = [Corroboration(NEUTRAL, Text(phrases.MARGIN_PARTS, parts=shares))] if shares else []
    loss = within(facts.hx_fouling, facts.hx_fouling_sd)
    corroborations.append(Corroboration(NEUTRAL, Text(phrases.NOT_WEAR_ALONE, loss=loss)))
    if facts.overheat_p20_k > 1.0:
        corroborations.append(
            Corroboration(SUPPORTS, Text(phrases.WARM_OUTLET, k=_figures(facts.overheat_p20_k, unit="K")))
        )
    return Evidence((finding,), (*corroborations, _full_open(facts)), phrases.MARGIN_ELSE, phrases.MARGIN_COSTS)


def _kelvin(margin_k: float) -> str:
    """Format a margin as a distance below or above a level."""
    if math.isnan(margin_k):
        return Text(phrases.FAR_UNKNOWN)
    phrase = phrases.BELOW_BY if margin_k >= 0.0 else phrases.ABOVE_BY
    return Text(phrase, k=_figures(abs(margin_k), unit="K"))


def compressor(facts: CompressorFacts, since: str) -> Evidence:
    """Return the evidence of wear: efficiency where the exit temperature is recorded, else effective diameter."""
    loss = facts.cc_efficiency_loss
    sd = facts.cc_efficiency_loss_sd
    change = facts.shrunk
    if not math.isnan(loss):
        finding = loss_finding(phrases.COMPRESSOR, loss, sd, WEAR_LIMIT, since, digits=1)
        return Evidence((finding,), _diameter(facts), phrases.COMPRESSOR_ELSE, phrases.COMPRESSOR_COSTS)
    sigma = _figures(-change / DIAMETER_SD, 1)
    finding = Text(phrases.SMALLER_DIAMETER, share=_percent(-change, 1), sigma=sigma, since=since)
    corroboration = Corroboration(NEUTRAL, phrases.NO_EFFICIENCY)
    return Evidence(
        (finding,), (corroboration, *_reserve(facts)), phrases.SMALLER_DIAMETER_ELSE, phrases.COMPRESSOR_COSTS
    )


def _diameter(facts: CompressorFacts) -> tuple[Corroboration, ...]:
    """Report the effective diameter, which shrinks by half of the efficiency loss: equation (5) takes its root."""
    loss = facts.cc_diameter_loss
    efficiency = facts.cc_efficiency_loss
    if math.isnan(loss):
        return ()
    role = SUPPORTS if loss > 0.25 * efficiency else NEUTRAL if loss > -DIAMETER_SD else AGAINST
    return (Corroboration(role, Text(phrases.DIAMETER_LOST, share=_percent(loss, 1))), *_reserve(facts))


def _reserve(facts: CompressorFacts) -> tuple[Corroboration, ...]:
    """Report by how much the effective diameter may shrink before the required flow is no longer delivered."""
    reserve = facts.cc_diameter_left
    hot_high = facts.cc_diameter_left_hot_high
    if math.isnan(reserve):
        return ()
    return graded(reserve, (0.0, NEUTRAL, phrases.DIAMETER_LEFT), (-math.inf, SUPPORTS, phrases.TOO_SMALL)) + graded(
        hot_high, (0.0, NEUTRAL, phrases.LEFT_HOT_HIGH), (-math.inf, NEUTRAL, phrases.SMALL_HOT_HIGH)
    )


def door(facts: DoorFacts, since: str) -> Evidence:
    """Return the evidence of a jam, or of travel that ends too soon."""
    stop = _percent(facts.stop)
    if facts.kind == "jam":
        flickers = Corroboration(SUPPORTS, phrases.FLICKERS)
        finding = Text(phrases.JAM, stop=stop, since=since)
        return Evidence((finding,), (flickers,), phrases.JAM_ELSE, phrases.JAM_COSTS)
    excess_k = facts.excess_k
    sigma = _figures(excess_k / PEG_SD_K)
    finding = Text(phrases.SHORT_TRAVEL, stop=stop, since=since, k=_figures(excess_k, 1, "K"), sigma=sigma)
    on_target = Corroboration(SUPPORTS, phrases.ON_TARGET)
    return Evidence((finding,), (on_target,), phrases.SHORT_TRAVEL_ELSE, phrases.SHORT_TRAVEL_COSTS)


def sensor(facts: SensorFacts, since: str) -> Evidence:
    """Return the evidence of a dropout, a frozen reading, or a shift against a cross check."""
    if facts.kind == CONTRADICTED:
        return _contradiction(facts, since)
    name = phrases.plain_name(facts.sensor)
    if facts.kind == "dropout":
        finding = Text(phrases.DROPOUT, sensor=name, share=_percent(facts.share), since=since)
        return Evidence((finding,), (), phrases.DROPOUT_ELSE, phrases.SENSOR_COSTS)
    if facts.kind == "frozen":
        finding = Text(phrases.FROZEN, sensor=name, since=since)
        return Evidence((finding,), (), phrases.FROZEN_ELSE, phrases.SENSOR_COSTS)
    finding = Text(
        phrases.SENSOR_SHIFT,
        sensor=name,
        check=phrases.plain_name(facts.channel),
        moved=_amount(facts.channel, facts.moved),
        sigma=_figures(facts.sigma, 1),
        since=since,
    )
    corroborations = [Corroboration(SUPPORTS, Text(phrases.SENSOR_FITS, odds=_probability(facts.p)))]
    if _is_of_both_packs(facts):
        corroborations.append(Corroboration(SUPPORTS, phrases.BOTH_SENSORS))
    return Evidence((finding,), tuple(corroborations), phrases.SENSOR_ELSE, phrases.SENSOR_COSTS)


def _contradiction(facts: SensorFacts, since: str) -> Evidence:
    """Return the evidence against the sensors of a part whose loss grows on though an inspection cleared it."""
    finding = Text(
        phrases.FOUND_CLEAN[facts.of],
        day=facts.looked_on,
        level=_percent(facts.level),
        loss=_percent(facts.loss),
        since=since,
    )
    corroborations = (Corroboration(SUPPORTS, phrases.CLEAN_LOSES_NOTHING),)
    return Evidence((finding,), corroborations, phrases.CLEAN_ELSE, phrases.SENSOR_COSTS)


def _amount(check: str, shift: float) -> Figures:
    """Format the shift of a check: in K, or for a logarithm in per cent."""
    return Figures(f"{shift:+.2f}", "K") if check.endswith("_k") else Figures(f"{100.0 * shift:+.1f}", "%")


def declared_loss(component: Component, limits: Limits, facts: LossFacts, since: str) -> Evidence:
    """Return the evidence of a declared component's wear, with the texts of the component's declaration."""
    loss = facts.loss
    lost = Text.whole(component.lost)
    name = Column(component.loss)
    warn_loss = component.warn_loss
    finding = loss_finding(phrases.UNIT_LOST, loss, facts.loss_sd, warn_loss, since, lost=lost, name=name)
    fails = Text(phrases.UNIT_FAILS, loss=within(component.limit.mean, component.limit.unit_sd))
    near = Corroboration(SUPPORTS if loss > HIGH_SEVERITY_SHARE * component.limit.mean else NEUTRAL, fails)
    sudden = graded(facts.loss_step_3, (limits.clog, NEUTRAL, phrases.UNIT_STEP))
    findings = (finding, *trend(facts.loss_slope_30_per_flight))
    return Evidence(findings, (near, *sudden), component.otherwise, component.waiting)
