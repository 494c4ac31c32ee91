"""A ram door that is jammed or ends its travel too soon."""

from dataclasses import dataclass

from hdt_core.alerts.cases import REPAIR
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.evidence import SUPPORTS, Corroboration, Evidence, figures, percent
from hdt_core.alerts.facts import Facts
from hdt_core.alerts.text import Phrase, Text

JAM = Phrase(
    "The ram door{ram_door_open} stays at {stop} % from climb to descent since {since} while its controller's need "
    "changes: less than 7 times its sensor's noise, on two of three flights"
)
FLICKERS = Phrase("its reading flickers, which that of a frozen sensor would not")
JAM_ELSE = Phrase("a frozen sensor")
JAM_COSTS = Phrase("Until repaired the outlet runs warm or cold, and the door can't make up for fouling")
SHORT_TRAVEL = Phrase(
    "The ram door{ram_door_open} goes no further than {stop} %: since {since} the outlet ran up to {k} ({sigma} "
    "times the scatter of a sound flight) above its target there"
)
ON_TARGET = Phrase("the outlet was on target wherever the door was not at that stop")
SHORT_TRAVEL_ELSE = Phrase("a fouled exchanger, which would open the door fully first")
SHORT_TRAVEL_COSTS = Phrase("Waiting costs temperature control on hot days")

PEG_SD_K = 0.33
"""Scatter, over sound flights, of the outlet where the door is widest less the outlet elsewhere. [K]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class DoorFacts(Facts):
    """Of a door that is jammed or ends its travel too soon."""

    kind: str
    stop: float
    excess_k: float


def door(facts: DoorFacts, since: str) -> Evidence:
    """Return the evidence of a jam, or of travel that ends too soon."""
    stop = percent(facts.stop)
    if facts.kind == "jam":
        flickers = Corroboration(SUPPORTS, FLICKERS)
        finding = Text(JAM, stop=stop, since=since)
        return Evidence((finding,), (flickers,), JAM_ELSE, JAM_COSTS)
    excess_k = facts.excess_k
    sigma = figures(excess_k / PEG_SD_K)
    finding = Text(SHORT_TRAVEL, stop=stop, since=since, k=figures(excess_k, 1, "K"), sigma=sigma)
    on_target = Corroboration(SUPPORTS, ON_TARGET)
    return Evidence((finding,), (on_target,), SHORT_TRAVEL_ELSE, SHORT_TRAVEL_COSTS)


DIAGNOSES = (
    Diagnosis(
        code="RAM_DOOR_FAULT",
        component="RAM_DOOR",
        name="ram air door fault",
        action="Operational test of the ram air inlet door and its actuator (ATA 21-53); rig or replace",
        ended_by=REPAIR,
        record=DoorFacts,
        severity=lambda facts: "high" if facts.kind == "jam" else "medium",
        evidence=door,
        limit="peg_k",
        limit_values=(0.9, 1.3, 1.8, 2.5),
    ),
)
