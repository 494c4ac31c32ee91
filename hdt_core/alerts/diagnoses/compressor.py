"""A worn compressor."""

import math
from dataclasses import dataclass
from math import nan

from hdt_core.alerts.cases import DIAMETER_SD, WEAR_LIMIT
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.evidence import (
    AGAINST,
    NEUTRAL,
    SUPPORTS,
    Corroboration,
    Evidence,
    figures,
    graded,
    loss_finding,
    percent,
)
from hdt_core.alerts.facts import FeatureFacts
from hdt_core.alerts.text import Phrase, Text
from hdt_core.components.pack import CC

COMPRESSOR = Phrase(
    "Compressor efficiency{cc_efficiency_loss} lost {loss} against expectation, {sigma} times its uncertainty, "
    "likely since "
    "{since}; worn at all (above {limit} %) with probability {odds}"
)
COMPRESSOR_ELSE = Phrase("a drifting exit temperature sensor")
COMPRESSOR_COSTS = Phrase("Waiting costs compressor power and, in the end, a flow message (21-51-CCFLOW)")
SMALLER_DIAMETER = Phrase(
    "Effective diameter{cc_effective_diameter_m} is {share} % below this unit's own first flights, {sigma} times the "
    "scatter of a flight and summed up beyond doubt (CUSUM), likely since {since}"
)
NO_EFFICIENCY = Phrase("no efficiency to compare with: the exit temperature is not recorded")
SMALLER_DIAMETER_ELSE = Phrase("a drifting speed or pressure sensor")
DIAMETER_LOST = Phrase("effective diameter lost{cc_diameter_loss} {share} %")
DIAMETER_LEFT = Phrase(
    "{share} % more of it{cc_diameter_left} may go before the flow of the last flight is no longer delivered"
)
TOO_SMALL = Phrase("at its highest speed {share} % too small{cc_diameter_left} for the flow of the last flight")
LEFT_HOT_HIGH = Phrase("at 41,000 ft on a hot day, ISA + 15 K, {share} % may go{cc_diameter_left_hot_high}")
SMALL_HOT_HIGH = Phrase("at 41,000 ft on a hot day, ISA + 15 K, it is {share} % too small{cc_diameter_left_hot_high}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CompressorFacts(FeatureFacts):
    """Of a worn compressor."""

    FROM_CASE = ("shrunk",)

    cc_efficiency_loss: float
    cc_efficiency_loss_sd: float
    cc_diameter_loss: float
    cc_diameter_left: float
    cc_diameter_left_hot_high: float
    shrunk: float = nan  # change of the effective diameter, as a share


def compressor(facts: CompressorFacts, since: str) -> Evidence:
    """Return the evidence of wear: efficiency where the exit temperature is recorded, else effective diameter."""
    loss = facts.cc_efficiency_loss
    sd = facts.cc_efficiency_loss_sd
    change = facts.shrunk
    if not math.isnan(loss):
        finding = loss_finding(COMPRESSOR, loss, sd, WEAR_LIMIT, since, digits=1)
        return Evidence((finding,), _diameter(facts), COMPRESSOR_ELSE, COMPRESSOR_COSTS)
    sigma = figures(-change / DIAMETER_SD, 1)
    finding = Text(SMALLER_DIAMETER, share=percent(-change, 1), sigma=sigma, since=since)
    corroboration = Corroboration(NEUTRAL, NO_EFFICIENCY)
    return Evidence((finding,), (corroboration, *_reserve(facts)), SMALLER_DIAMETER_ELSE, COMPRESSOR_COSTS)


def _diameter(facts: CompressorFacts) -> tuple[Corroboration, ...]:
    """Report the effective diameter, which shrinks by half of the efficiency loss: equation (5) takes its root."""
    loss = facts.cc_diameter_loss
    efficiency = facts.cc_efficiency_loss
    if math.isnan(loss):
        return ()
    role = SUPPORTS if loss > 0.25 * efficiency else NEUTRAL if loss > -DIAMETER_SD else AGAINST
    return (Corroboration(role, Text(DIAMETER_LOST, share=percent(loss, 1))), *_reserve(facts))


def _reserve(facts: CompressorFacts) -> tuple[Corroboration, ...]:
    """Report by how much the effective diameter may shrink before the required flow is no longer delivered."""
    reserve = facts.cc_diameter_left
    hot_high = facts.cc_diameter_left_hot_high
    if math.isnan(reserve):
        return ()
    return graded(reserve, (0.0, NEUTRAL, DIAMETER_LEFT), (-math.inf, SUPPORTS, TOO_SMALL)) + graded(
        hot_high, (0.0, NEUTRAL, LEFT_HOT_HIGH), (-math.inf, NEUTRAL, SMALL_HOT_HIGH)
    )


DIAGNOSES = (
    Diagnosis(
        code="CC_DEGRADED",
        component="CC",
        name="compressor worn",
        action=CC.action,
        ended_by=CC.ended_by,
        record=CompressorFacts,
        severity=lambda facts: "medium",
        evidence=compressor,
        loss="cc_efficiency_loss",
        limit="compressor",
        limit_values=(0.03, 0.04, 0.05, 0.07),
        is_wear=True,
    ),
)
