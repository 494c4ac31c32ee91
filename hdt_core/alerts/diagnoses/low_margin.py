"""Little cooling margin left, which wear alone does not explain."""

import math
from dataclasses import dataclass

from hdt_core.alerts.diagnoses.exchanger import ExchangerFacts, full_open
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.evidence import NEUTRAL, SUPPORTS, Corroboration, Evidence, figures, probability, within
from hdt_core.alerts.text import Figures, Phrase, Text, TextList
from hdt_core.components.pack import HX

MARGIN = Phrase(
    "With the ram door full open the outlet would stand {margin} its level in the hottest fifth of the last flight, "
    "{hot_day} it on a hot day (ISA + 15 K); message 21-52-HXTEMP within 300 flights with probability {odds} by "
    "physics alone, likely since {since}"
)
BELOW_BY = Phrase("{k} below")
ABOVE_BY = Phrase("{k} above")
FAR_UNKNOWN = Phrase("at an unknown distance from")
MARGIN_PARTS = Phrase("what makes the margin: {parts}")
BY_DESIGN = Phrase("the design gives {k}")
BY_TARGET = Phrase("target {k}")
BY_FLOW = Phrase("flow {k}")
BY_AIR = Phrase("air outside {k}")
BY_WEAR = Phrase("wear and build {k}")
NOT_WEAR_ALONE = Phrase("Heat transfer lost{hx_fouling} {loss}: wear alone does not explain it")
WARM_OUTLET = Phrase("on the last flight the outlet was {k} above its level, door full open")
MARGIN_ELSE = Phrase("a cooler season, or an outlet sensor that reads high")
MARGIN_COSTS = Phrase("Waiting costs the message on a hot day, and an exchanger that is taken off in vain")


@dataclass(frozen=True, slots=True, kw_only=True)
class MarginFacts(ExchangerFacts):
    """Of an exchanger with little cooling margin left."""

    hx_passage_100: float
    hx_passage_300: float
    hx_margin_k: float
    hx_margin_hot_day_k: float
    hx_margin_design_k: float
    hx_margin_target_k: float
    hx_margin_flow_k: float
    hx_margin_ambient_k: float
    hx_margin_wear_k: float
    overheat_p20_k: float


def low_margin(facts: MarginFacts, since: str) -> Evidence:
    """Return the evidence of little reserve before the message, with its parts."""
    finding = Text(
        MARGIN,
        margin=_kelvin(facts.hx_margin_k),
        hot_day=_kelvin(facts.hx_margin_hot_day_k),
        odds=probability(facts.hx_passage_300),
        since=since,
    )
    parts = (
        (BY_DESIGN, facts.hx_margin_design_k),
        (BY_TARGET, facts.hx_margin_target_k),
        (BY_FLOW, facts.hx_margin_flow_k),
        (BY_AIR, facts.hx_margin_ambient_k),
        (BY_WEAR, facts.hx_margin_wear_k),
    )
    shares = TextList((Text(phrase, k=Figures(f"{k:+.0f}", "K")) for phrase, k in parts if not math.isnan(k)), ", ")
    corroborations = [Corroboration(NEUTRAL, Text(MARGIN_PARTS, parts=shares))] if shares else []
    loss = within(facts.hx_fouling, facts.hx_fouling_sd)
    corroborations.append(Corroboration(NEUTRAL, Text(NOT_WEAR_ALONE, loss=loss)))
    if facts.overheat_p20_k > 1.0:
        corroborations.append(Corroboration(SUPPORTS, Text(WARM_OUTLET, k=figures(facts.overheat_p20_k, unit="K"))))
    return Evidence((finding,), (*corroborations, full_open(facts)), MARGIN_ELSE, MARGIN_COSTS)


def _kelvin(margin_k: float) -> str:
    """Format a margin as a distance below or above a level."""
    if math.isnan(margin_k):
        return Text(FAR_UNKNOWN)
    phrase = BELOW_BY if margin_k >= 0.0 else ABOVE_BY
    return Text(phrase, k=figures(abs(margin_k), unit="K"))


DIAGNOSES = (
    Diagnosis(
        code="HX_LOW_MARGIN",
        component="HX",
        name="little cooling margin left",
        action="Check outlet target, flow schedule and ram door travel (ATA 21-53, rigging); a new exchanger "
        "alone does not remove the cause; keep the aircraft off hot sectors where it can be, and wash at the next "
        "stop",
        ended_by=HX.ended_by,
        record=MarginFacts,
        severity=lambda facts: "high" if facts.hx_passage_100 > 0.5 else "medium",
        evidence=low_margin,
        ended_by_sound=False,  # its evidence already excludes wear as the only cause
        limit="passage",
        limit_values=(0.70, 0.80, 0.90, 0.95, 0.98),
    ),
)
