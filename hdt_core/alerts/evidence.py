"""Evidence of each diagnosis: what changed and since when, observations for and against it, the cost of waiting."""

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
from hdt_core.components import Component
from hdt_core.robust import Z_90

SUPPORTS, NEUTRAL, AGAINST = ROLES = ("Supports", "Neutral", "Against")


class Corroboration(NamedTuple):
    """An independent observation that bears on an alert: its role (of `ROLES`) and its text."""

    role: str
    text: str


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of an alert at one moment.

    Attributes
    ----------
    finding : str
        What changed, by how much, since when.
    corroborations : tuple of Corroboration
        Other observations, each with its role.
    otherwise : str
        Other explanations.
    waiting : str
        Cost of waiting.
    """

    finding: str
    corroborations: tuple[Corroboration, ...]
    otherwise: str
    waiting: str

    def text(self) -> str:
        """Return one paragraph: the finding, its corroborations by role, the alternatives, the cost."""
        by_role = ((role, [w.text for w in self.corroborations if w.role == role]) for role in ROLES)
        sentences = [f"{role}: {'; '.join(texts)}." for role, texts in by_role if texts]
        return " ".join([f"{self.finding}.", *sentences, f"Else: {self.otherwise}.", f"{self.waiting}."])


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


def sensor_addendum(facts: SensorFacts) -> str:
    """Return the sensor by what it measures; of a contradiction, what to compare."""
    if facts.kind == CONTRADICTED:
        return phrases.COMPARE.format(day=facts.looked_on)
    phrase = phrases.BOTH_NAMED if _is_of_both_packs(facts) else phrases.SENSOR_NAMED
    return phrase.format(sensor=phrases.plain_name(facts.sensor))


def _is_of_both_packs(facts: SensorFacts) -> bool:
    return is_of_both_packs(facts.sensor, facts.whose)


def within(value: float, sd: float, digits: int = 0) -> str:
    """Format a share in per cent with its interval of 90 %.

    Examples
    --------
    >>> within(0.34, 0.01)
    '34 % (32 to 36)'
    """
    low, high = (f"{100.0 * (value + side * Z_90 * sd):.{digits}f}" for side in (-1, 1))
    return phrases.WITHIN.format(value=f"{100.0 * value:.{digits}f}", low=low, high=high)


def _percent(share: float) -> str:
    return f"{100 * share:.0f}"


def _probability(p: float) -> str:
    """Format a probability, capped below certainty."""
    return phrases.ABOVE.format(value=0.99) if p > 0.99 else f"{p:.2f}"


def chance_above(value: float, limit: float, sd: float) -> str:
    """Format the probability that the true value exceeds the limit."""
    return _probability(float(ndtr((value - limit) / max(sd, 1e-6))))


def loss_finding(phrase: str, loss: float, sd: float, limit: float, since: str, digits: int = 0, **names: str) -> str:
    """Format a loss with its interval, its distance from 0, and the probability that it exceeds the limit."""
    return phrase.format(
        loss=within(loss, sd, digits),
        sigma=f"{loss / max(sd, 1e-6):.0f}",
        limit=_percent(limit),
        since=since,
        odds=chance_above(loss, limit, sd),
        **names,
    )


def trend(slope: float) -> list[str]:
    """Format the growth of a loss over thirty flights; empty where it does not grow."""
    return [phrases.TREND.format(points=f"{1000 * slope:.1f}")] if slope > 1e-5 else []


def exchanger(facts: ExchangerFacts, since: str, clean_flow: str = NEUTRAL) -> Evidence:
    """Return the evidence of fouling; `clean_flow`: the role of a ram flow that is not reduced."""
    loss = facts.hx_fouling
    sd = facts.hx_fouling_sd
    findings = [loss_finding(phrases.UA_LOST, loss, sd, WEAR_LIMIT, since)]
    findings += trend(facts.hx_fouling_slope_30_per_flight)
    if facts.gained > loss + 2.0 * sd:
        findings.append(phrases.RISE.format(points=_percent(facts.gained)))
    # a blockage starves the ram flow, a film does not; known where the ram outlet is measured
    ram_flow = graded(
        facts.ram_flow_loss,
        (RAM_FLOW_LOSS, SUPPORTS, phrases.FLOW_BLOCKED),
        (-math.inf, clean_flow, phrases.FLOW_CLEAN),
    )
    corroborations = (_full_open(facts), *_beside(facts), *ram_flow)
    return Evidence("; ".join(findings), corroborations, phrases.EXCHANGER_ELSE, phrases.EXCHANGER_COSTS)


def clog(facts: ExchangerFacts, since: str) -> Evidence:
    """Return the evidence of a sudden clog: fouling with a jump too fast for wear."""
    fouling = exchanger(facts, since, AGAINST)
    return replace(fouling, finding=f"{fouling.finding}; " + phrases.JUMP.format(points=_percent(facts.jump)))


def graded(value: float, *grades: tuple[float, str, str]) -> tuple[Corroboration, ...]:
    """Return the observation of the first grade (limit, role, phrase) that the value exceeds; none where it is unknown.

    The phrase takes the value's size in per cent, as `share` or as `points`.
    """
    percent = _percent(abs(value))
    for limit, role, phrase in grades:
        if value > limit:
            return (Corroboration(role, phrase.format(share=percent, points=percent)),)
    return ()


def _full_open(facts: ExchangerFacts) -> Corroboration:
    """Report whether the door is full open, so that the controller lacks ram air."""
    share = facts.door_full_open_share
    if math.isnan(share):
        return Corroboration(NEUTRAL, phrases.DOOR_UNKNOWN)
    role, phrase = (NEUTRAL, phrases.DOOR_SPARE) if share < FULL_OPEN_SHARE else (SUPPORTS, phrases.DOOR_FULL)
    return Corroboration(role, phrase.format(share=_percent(share)))


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
    finding = phrases.MARGIN.format(
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
    shares = ", ".join(phrase.format(k=f"{k:+.0f}") for phrase, k in parts if not math.isnan(k))
    corroborations = [Corroboration(NEUTRAL, phrases.MARGIN_PARTS.format(parts=shares))] if shares else []
    loss = within(facts.hx_fouling, facts.hx_fouling_sd)
    corroborations.append(Corroboration(NEUTRAL, phrases.NOT_WEAR_ALONE.format(loss=loss)))
    if facts.overheat_p20_k > 1.0:
        corroborations.append(Corroboration(SUPPORTS, phrases.WARM_OUTLET.format(k=f"{facts.overheat_p20_k:.0f}")))
    return Evidence(finding, (*corroborations, _full_open(facts)), phrases.MARGIN_ELSE, phrases.MARGIN_COSTS)


def _kelvin(margin_k: float) -> str:
    """Format a margin as a distance below or above a level."""
    if math.isnan(margin_k):
        return phrases.FAR_UNKNOWN
    phrase = phrases.BELOW_BY if margin_k >= 0.0 else phrases.ABOVE_BY
    return phrase.format(k=f"{abs(margin_k):.0f}")


def compressor(facts: CompressorFacts, since: str) -> Evidence:
    """Return the evidence of wear: efficiency where the exit temperature is recorded, else effective diameter."""
    loss = facts.cc_efficiency_loss
    sd = facts.cc_efficiency_loss_sd
    change = facts.shrunk
    if not math.isnan(loss):
        finding = loss_finding(phrases.COMPRESSOR, loss, sd, WEAR_LIMIT, since, digits=1)
        return Evidence(finding, _diameter(facts), phrases.COMPRESSOR_ELSE, phrases.COMPRESSOR_COSTS)
    smaller = f"{-100 * change:.1f}"
    sigma = f"{-change / DIAMETER_SD:.1f}"
    finding = phrases.SMALLER_DIAMETER.format(share=smaller, sigma=sigma, since=since)
    corroboration = Corroboration(NEUTRAL, phrases.NO_EFFICIENCY)
    return Evidence(finding, (corroboration, *_reserve(facts)), phrases.SMALLER_DIAMETER_ELSE, phrases.COMPRESSOR_COSTS)


def _diameter(facts: CompressorFacts) -> tuple[Corroboration, ...]:
    """Report the effective diameter, which shrinks by half of the efficiency loss: equation (5) takes its root."""
    loss = facts.cc_diameter_loss
    efficiency = facts.cc_efficiency_loss
    if math.isnan(loss):
        return ()
    role = SUPPORTS if loss > 0.25 * efficiency else NEUTRAL if loss > -DIAMETER_SD else AGAINST
    return (Corroboration(role, phrases.DIAMETER_LOST.format(share=f"{100 * loss:.1f}")), *_reserve(facts))


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
        finding = phrases.JAM.format(stop=stop, since=since)
        return Evidence(finding, (flickers,), phrases.JAM_ELSE, phrases.JAM_COSTS)
    excess_k = facts.excess_k
    finding = phrases.SHORT_TRAVEL.format(
        stop=stop, since=since, k=f"{excess_k:.1f}", sigma=f"{excess_k / PEG_SD_K:.0f}"
    )
    return Evidence(
        finding, (Corroboration(SUPPORTS, phrases.ON_TARGET),), phrases.SHORT_TRAVEL_ELSE, phrases.SHORT_TRAVEL_COSTS
    )


def sensor(facts: SensorFacts, since: str) -> Evidence:
    """Return the evidence of a dropout, a frozen reading, or a shift against a cross check."""
    if facts.kind == CONTRADICTED:
        return _contradiction(facts, since)
    name = phrases.plain_name(facts.sensor)
    name = name[:1].upper() + name[1:]
    if facts.kind == "dropout":
        finding = phrases.DROPOUT.format(sensor=name, share=_percent(facts.share), since=since)
        return Evidence(finding, (), phrases.DROPOUT_ELSE, phrases.SENSOR_COSTS)
    if facts.kind == "frozen":
        return Evidence(phrases.FROZEN.format(sensor=name, since=since), (), phrases.FROZEN_ELSE, phrases.SENSOR_COSTS)
    finding = phrases.SENSOR_SHIFT.format(
        sensor=name,
        check=phrases.plain_name(facts.channel),
        moved=_amount(facts.channel, facts.moved),
        sigma=f"{facts.sigma:.1f}",
        since=since,
    )
    corroborations = [Corroboration(SUPPORTS, phrases.SENSOR_FITS.format(odds=_probability(facts.p)))]
    if _is_of_both_packs(facts):
        corroborations.append(Corroboration(SUPPORTS, phrases.BOTH_SENSORS))
    return Evidence(finding, tuple(corroborations), phrases.SENSOR_ELSE, phrases.SENSOR_COSTS)


def _contradiction(facts: SensorFacts, since: str) -> Evidence:
    """Return the evidence against the sensors of a part whose loss grows on though an inspection cleared it."""
    finding = phrases.FOUND_CLEAN[facts.of].format(
        day=facts.looked_on, level=_percent(facts.level), loss=_percent(facts.loss), since=since
    )
    corroborations = (Corroboration(SUPPORTS, phrases.CLEAN_LOSES_NOTHING),)
    return Evidence(finding, corroborations, phrases.CLEAN_ELSE, phrases.SENSOR_COSTS)


def _amount(check: str, shift: float) -> str:
    """Format the shift of a check: in K, or for a logarithm in per cent."""
    return f"{shift:+.2f} K" if check.endswith("_k") else f"{100.0 * shift:+.1f} %"


def declared_loss(component: Component, limits: Limits, facts: LossFacts, since: str) -> Evidence:
    """Return the evidence of a declared component's wear, with the texts of the component's declaration."""
    loss = facts.loss
    sd = facts.loss_sd
    slope = facts.loss_slope_30_per_flight
    lost = component.lost
    name = component.loss
    finding = loss_finding(phrases.UNIT_LOST, loss, sd, component.warn_loss, since, lost=lost, name=name)
    fails = phrases.UNIT_FAILS.format(loss=within(component.limit.mean, component.limit.unit_sd))
    near = Corroboration(SUPPORTS if loss > HIGH_SEVERITY_SHARE * component.limit.mean else NEUTRAL, fails)
    sudden = graded(facts.loss_step_3, (limits.clog, NEUTRAL, phrases.UNIT_STEP))
    return Evidence("; ".join([finding, *trend(slope)]), (near, *sudden), component.otherwise, component.waiting)
