"""A sensor that drops out, freezes or shifts, or that an inspection of another part contradicts."""

from dataclasses import dataclass
from math import nan

from hdt_core.alerts import phrases
from hdt_core.alerts.cases import REPAIR
from hdt_core.alerts.diagnosis import Diagnosis
from hdt_core.alerts.evidence import SUPPORTS, Corroboration, Evidence, figures, percent, probability
from hdt_core.alerts.facts import Facts
from hdt_core.alerts.fault_isolation import is_of_both_packs
from hdt_core.alerts.text import Figures, Phrase, Text

DROPOUT = Phrase(
    "{sensor} is empty in {share} % of its readings since {since}, on two of three flights; a sound sensor loses about "
    "1 %"
)
DROPOUT_ELSE = Phrase("a loose connector or the recorder's bus")
FROZEN = Phrase(
    "{sensor} shows one value, or none that can be true, from climb to descent since {since}, though what it measures "
    "moves, on two of three flights"
)
FROZEN_ELSE = Phrase("its converter or the recorder's bus")
SENSOR_SHIFT = Phrase(
    "{sensor} left what physics ties it to: {check} moved by {moved} ({sigma} times its uncertainty) since {since}"
)
SENSOR_FITS = Phrase("the pattern over all cross checks fits this sensor with probability {odds}")
BOTH_SENSORS = Phrase(
    "on the other pack the same sensor moved with it: one change of scale, map or software, not two faults"
)
BOTH_LOST = Phrase("the other pack lost the same sensor with it: one fault of recorder, map or export, not two sensors")
SENSOR_ELSE = Phrase("another sensor of the same checks; wear leaves them alone")
SENSOR_COSTS = Phrase("Until it is replaced the pack's health is judged without it, and less surely")
SENSOR_NAMED = Phrase("; sensor: {sensor}")
BOTH_NAMED = Phrase(
    "; but {sensor} changed on both packs at once: look at the recorder's scale, map and software first"
)
COMPARE = Phrase(
    "; found clean on {day}, so neither wash nor new part yet: compare what the loss stands on with the other pack's "
    "on one flight; where all agree, wash, for a film inside is not seen from outside"
)
_GROWTH = "was found clean on {day} at a loss of {level} %, and the loss has grown to {loss} % since {since}"
FOUND_CLEAN = {
    "HX": Phrase(
        f"The heat exchanger {_GROWTH}: check the sensors it stands on (inlet and outlet temperature of the "
        "exchanger, pack flow, total air temperature)"
    ),
    "CC": Phrase(
        f"The compressor {_GROWTH}: check the sensors it stands on (temperatures and pressures at its inlet and exit)"
    ),
}
CLEAN_LOSES_NOTHING = Phrase("the inspection: a clean part loses nothing more")
CLEAN_ELSE = Phrase("a film that the inspection could not see, or dust since")

ESTIMATE_SENSORS = ("hx_out_k", "hx_in_k", "pack_flow_kg_s", "tat_k")
"""Sensors that the fouling estimate depends on."""
CONTRADICTED = "contradicted"
"""Kind of a sensor case raised by an inspection of another part."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorFacts(Facts):
    """Of a sensor that drops out, freezes or shifts, or that an inspection of another part contradicts."""

    kind: str
    sensor: str = ""
    whose: str = "own"
    share: float = nan  # of readings lost
    channel: str = ""  # cross check that shows a shift
    moved: float = nan  # by how much it moved, in its unit
    sigma: float = nan
    p: float = nan  # that it is this sensor
    of: str = ""  # component that was found clean
    looked_on: str = ""
    level: float = nan  # of the loss that was found clean
    loss: float = nan


def sensor_severity(facts: SensorFacts) -> str:
    """Return medium for a sensor that the health estimate depends on."""
    return "medium" if facts.kind == CONTRADICTED or facts.sensor in ESTIMATE_SENSORS else "low"


def sensor_addendum(facts: SensorFacts) -> tuple[Text, ...]:
    """Return the sensor by what it measures; of a contradiction, what to compare."""
    if facts.kind == CONTRADICTED:
        return (Text(COMPARE, day=facts.looked_on),)
    phrase = BOTH_NAMED if _is_of_both_packs(facts) else SENSOR_NAMED
    return (Text(phrase, sensor=phrases.plain_name(facts.sensor)),)


def _is_of_both_packs(facts: SensorFacts) -> bool:
    return is_of_both_packs(facts.sensor, facts.whose)


def sensor(facts: SensorFacts, since: str) -> Evidence:
    """Return the evidence of a dropout, a frozen reading, or a shift against a cross check."""
    if facts.kind == CONTRADICTED:
        return _contradiction(facts, since)
    name = phrases.plain_name(facts.sensor)
    lost_too = (Corroboration(SUPPORTS, BOTH_LOST),) if _is_of_both_packs(facts) else ()
    if facts.kind == "dropout":
        finding = Text(DROPOUT, sensor=name, share=percent(facts.share), since=since)
        return Evidence((finding,), lost_too, DROPOUT_ELSE, SENSOR_COSTS)
    if facts.kind == "frozen":
        finding = Text(FROZEN, sensor=name, since=since)
        return Evidence((finding,), lost_too, FROZEN_ELSE, SENSOR_COSTS)
    finding = Text(
        SENSOR_SHIFT,
        sensor=name,
        check=phrases.plain_name(facts.channel),
        moved=_amount(facts.channel, facts.moved),
        sigma=figures(facts.sigma, 1),
        since=since,
    )
    corroborations = [Corroboration(SUPPORTS, Text(SENSOR_FITS, odds=probability(facts.p)))]
    if _is_of_both_packs(facts):
        corroborations.append(Corroboration(SUPPORTS, BOTH_SENSORS))
    return Evidence((finding,), tuple(corroborations), SENSOR_ELSE, SENSOR_COSTS)


def _contradiction(facts: SensorFacts, since: str) -> Evidence:
    """Return the evidence against the sensors of a part whose loss grows on though an inspection cleared it."""
    finding = Text(
        FOUND_CLEAN[facts.of],
        day=facts.looked_on,
        level=percent(facts.level),
        loss=percent(facts.loss),
        since=since,
    )
    corroborations = (Corroboration(SUPPORTS, CLEAN_LOSES_NOTHING),)
    return Evidence((finding,), corroborations, CLEAN_ELSE, SENSOR_COSTS)


def _amount(check: str, shift: float) -> Figures:
    """Format the shift of a check: in K, or for a logarithm in per cent."""
    return Figures(f"{shift:+.2f}", "K") if check.endswith("_k") else Figures(f"{100.0 * shift:+.1f}", "%")


DIAGNOSES = (
    Diagnosis(
        code="SENSOR_FAULT",
        component="SENSOR",
        name="sensor fault",
        action="Check connector and wiring, then replace the sensor (ATA 21-61)",
        ended_by=REPAIR,
        record=SensorFacts,
        severity=sensor_severity,
        evidence=sensor,
        addendum=sensor_addendum,
    ),
)
