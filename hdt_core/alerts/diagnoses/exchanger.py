"""A worn exchanger, and one that clogged suddenly."""

import math
from dataclasses import dataclass, replace
from math import nan

from hdt_core.alerts.cases import FAILS_AT, WEAR_LIMIT
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.evidence import (
    AGAINST,
    NEUTRAL,
    SUPPORTS,
    Corroboration,
    Evidence,
    graded,
    loss_finding,
    percent,
    trend,
)
from hdt_core.alerts.facts import FeatureFacts
from hdt_core.alerts.text import Phrase, Text
from hdt_core.components.pack import HX

UA_LOST = Phrase(
    "Heat transfer lost{hx_fouling} {loss}, {sigma} times its uncertainty; above {limit} % since {since}, and with "
    "probability {odds}"
)
RISE = Phrase("its last ten flights alone lost {points} points more than its ten best")
EXCHANGER_ELSE = Phrase(
    "a door or outlet sensor at fault, if an alert of its own is open; icing would go by the next flight"
)
EXCHANGER_COSTS = Phrase("Waiting costs ram drag and, when the door has no travel left, the message 21-52-HXTEMP")
JUMP = Phrase("{points} points of it within three flights, which wear doesn't do")
DOOR_UNKNOWN = Phrase("door position unknown")
DOOR_SPARE = Phrase("ram door full open in {share} % of cruise: it can still make up for the loss")
DOOR_FULL = Phrase("ram door full open in {share} % of cruise")
DOOR_ALIKE = Phrase("ram door about as wide as that of the other pack, which has lost less")
DOOR_WIDER = Phrase("ram door {points} points wider than that of the other pack")
DOOR_NARROWER = Phrase("ram door {points} points narrower than that of the other pack, which has lost less")
OTHER_LESS = Phrase("the other pack has lost {points} points less on the same flights")
OTHER_ALIKE = Phrase("the other pack has lost as much: the same dust, or an error both share")
FLOW_BLOCKED = Phrase("ram flow {share} % below a clean duct's, as a blocked core has it")
FLOW_CLEAN = Phrase("ram flow that of a clean duct: no blockage")

FULL_OPEN_SHARE = 0.05
"""Share of cruise with the door full open that a sound pack shows on one flight in a hundred. [-]"""
DOOR_DIFFERENCE, LOSS_DIFFERENCE, RAM_FLOW_LOSS = 0.03, 0.05, 0.04
"""Differences beyond chance between packs of one aircraft, and against a clean duct: three standard deviations. [-]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExchangerFacts(FeatureFacts):
    """Of a worn or clogged exchanger."""

    FROM_CASE = ("gained", "jump")

    hx_fouling: float
    hx_fouling_sd: float
    hx_fouling_slope_30_per_flight: float
    hx_fouling_between_packs: float
    door_full_open_share: float
    door_median_between_packs: float
    ram_flow_loss: float
    gained: float = nan  # by its last ten flights over its ten best
    jump: float = nan  # within three flights


def exchanger_severity(facts: ExchangerFacts) -> str:
    """Return high where failure is near."""
    flights = flights_left(facts)
    return "high" if facts.hx_fouling > 0.3 or (flights is not None and flights < 50) else "medium"


def flights_left(facts: ExchangerFacts) -> float | None:
    """Extrapolate the flights to the loss at which packs fail, for the severity; None where the loss does not grow."""
    slope = facts.hx_fouling_slope_30_per_flight
    return max((FAILS_AT - facts.hx_fouling) / slope, 0.0) if slope > 1e-5 else None


def exchanger(facts: ExchangerFacts, since: str, clean_flow: str = NEUTRAL) -> Evidence:
    """Return the evidence of fouling; `clean_flow`: the role of a ram flow that is not reduced."""
    loss = facts.hx_fouling
    sd = facts.hx_fouling_sd
    findings = [loss_finding(UA_LOST, loss, sd, WEAR_LIMIT, since)]
    findings += trend(facts.hx_fouling_slope_30_per_flight)
    if facts.gained > loss + 2.0 * sd:
        findings.append(Text(RISE, points=percent(facts.gained)))
    # a blockage starves the ram flow, a film does not; known where the ram outlet is measured
    ram_flow = graded(
        facts.ram_flow_loss,
        (RAM_FLOW_LOSS, SUPPORTS, FLOW_BLOCKED),
        (-math.inf, clean_flow, FLOW_CLEAN),
    )
    corroborations = (full_open(facts), *_beside(facts), *ram_flow)
    return Evidence(tuple(findings), corroborations, EXCHANGER_ELSE, EXCHANGER_COSTS)


def clog(facts: ExchangerFacts, since: str) -> Evidence:
    """Return the evidence of a sudden clog: fouling with a jump too fast for wear."""
    fouling = exchanger(facts, since, AGAINST)
    jump = Text(JUMP, points=percent(facts.jump))
    return replace(fouling, findings=(*fouling.findings, jump))


def full_open(facts: ExchangerFacts) -> Corroboration:
    """Report whether the door is full open, so that the controller lacks ram air."""
    share = facts.door_full_open_share
    if math.isnan(share):
        return Corroboration(NEUTRAL, DOOR_UNKNOWN)
    role, phrase = (NEUTRAL, DOOR_SPARE) if share < FULL_OPEN_SHARE else (SUPPORTS, DOOR_FULL)
    return Corroboration(role, Text(phrase, share=percent(share)))


def _beside(facts: ExchangerFacts) -> tuple[Corroboration, ...]:
    """Compare both packs: the door of that which lost more stands wider; a loss of both may have a common cause."""
    wider = facts.door_median_between_packs
    more = facts.hx_fouling_between_packs
    doors = graded(
        wider,
        (DOOR_DIFFERENCE, SUPPORTS, DOOR_WIDER),
        (-DOOR_DIFFERENCE, NEUTRAL, DOOR_ALIKE),
        (-math.inf, AGAINST, DOOR_NARROWER),
    )
    losses = graded(more, (LOSS_DIFFERENCE, SUPPORTS, OTHER_LESS), (-math.inf, NEUTRAL, OTHER_ALIKE))
    return (*doors, *losses) if more > LOSS_DIFFERENCE else losses


DIAGNOSES = (
    Diagnosis(
        code="HX_FOULING",
        component="HX",
        name="heat exchanger fouling",
        action=HX.action,
        ended_by=HX.ended_by,
        record=ExchangerFacts,
        severity=exchanger_severity,
        evidence=exchanger,
        loss="hx_fouling",
        limit="fouling",
        limit_values=(0.10, 0.125, 0.15, 0.20, 0.25),
        is_wear=True,
    ),
    Diagnosis(
        code="HX_SUDDEN_CLOG",
        component="HX",
        name="heat exchanger clogged suddenly",
        action="Inspect ram air inlet and core face for foreign objects before the next long sector "
        "(ATA 21-52, detailed visual inspection)",
        ended_by=HX.ended_by,
        record=ExchangerFacts,
        severity=lambda facts: "high",
        evidence=clog,
        loss="hx_fouling",
        limit="clog",
        limit_values=(0.07, 0.10, 0.15, 0.20),
    ),
)
