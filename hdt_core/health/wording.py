"""A case in words: how bad, what moved and since when, what else it could be, what waiting costs, what to do."""

import math
from collections.abc import Mapping
from typing import Any

from scipy.special import ndtr

from hdt_core.health.episodes import DIAMETER_SD, FAILS_AT, Case
from hdt_core.health.grid import Grid
from hdt_core.tables.raw import Signals

ACTIONS = {
    "HX_FOULING": "Plan a wash or replacement of the heat exchanger (ATA 21-52, remove/install); "
    "look at ram inlet and core face first",
    "HX_SUDDEN_CLOG": "Inspect ram air inlet and core face for foreign objects before the next long sector "
    "(ATA 21-52, detailed visual inspection)",
    "CC_DEGRADED": "Borescope the cabin air compressor and check its diffuser actuator (ATA 21-51); plan replacement",
    "RAM_DOOR_FAULT": "Operational test of the ram air inlet door and its actuator (ATA 21-53); rig or replace",
    "SENSOR_FAULT": "Check connector and wiring, then replace the sensor (ATA 21-61)",
}
WORN = 0.05
"""Loss from which a unit counts as worn at all. [-]"""
PEG_SD_K = 0.33
"""Scatter, over sound flights, of the outlet where the door is widest less the outlet elsewhere. [K]"""
WITHOUT = "Until it is replaced the pack's health is judged without it, and less surely."
LEANED_ON = ("hx_out_k", "hx_in_k", "pack_flow_kg_s", "tat_k")
"""Sensors that the fouling estimate stands on."""


def explain(alert: Mapping[str, Any]) -> str:
    """One plain paragraph about a row of `alerts`."""
    side = "left" if alert["pack"] == 1 else "right"
    state = "still open" if alert["closed_at"] is None else f"closed {alert['closed_at']:%Y-%m-%d}"
    return (
        f"{alert['operator']} {alert['tail']}, pack {alert['pack']} ({side}): {alert['diagnosis']}, severity "
        f"{alert['severity']}, raised after flight {alert['raised_flight_id']} on {alert['raised_at']:%Y-%m-%d}, "
        f"{state}. {alert['evidence']} To do: {alert['recommended_action']}."
    )


def severity(case: Case) -> str:
    """`low`, `medium` or `high`."""
    facts = case.facts
    if case.component == "HX":
        left = flights_left(facts)
        near = facts["hx_fouling"] > 0.3 or (left is not None and left < 50)
        return "high" if near or case.diagnosis == "HX_SUDDEN_CLOG" else "medium"
    if case.component == "SENSOR":
        return "medium" if facts["sensor"] in LEANED_ON else "low"
    return "high" if facts.get("kind") == "jam" else "medium"


def flights_left(facts: Mapping[str, Any]) -> float | None:
    """Straight-line flights to the loss at which packs fail; None where the loss doesn't grow."""
    slope = facts["hx_fouling_slope_30_per_flight"]
    return max((FAILS_AT - facts["hx_fouling"]) / slope, 0.0) if slope > 1e-5 else None


def action(case: Case) -> str:
    """The maintenance task."""
    sensor = case.facts.get("sensor")
    return ACTIONS[case.diagnosis] + (f"; sensor: {_meaning(sensor)} ({sensor})" if sensor else "")


def _meaning(sensor: str) -> str:
    """What a sensor measures, without the paper's number of it."""
    said = Signals.columns()[sensor].metadata or {}
    return str(said["meaning"]).partition(" (")[0]


def evidence(grid: Grid, case: Case) -> str:
    """What moved, by how much and since when, what else could explain it, and what waiting costs."""
    since = str(grid.at("flight_id", case.unit, int(case.facts["since"])))
    words = {"HX": _exchanger, "CC": _compressor, "RAM_DOOR": _door, "SENSOR": _sensor}
    return words[case.component](case, since)


def _probability(above: float, sd: float) -> str:
    """Chance that an estimate so far above a limit is truly above it, in words; never a certainty."""
    p = float(ndtr(above / max(sd, 1e-6)))
    return "above 0.99" if p > 0.99 else f"{p:.2f}"


def _exchanger(case: Case, since: str) -> str:
    facts = case.facts
    loss, sd, left = facts["hx_fouling"], facts["hx_fouling_sd"], flights_left(facts)
    waiting = (
        "The trend is flat: waiting costs ram drag only"
        if left is None
        else f"At the trend of its last 30 flights it can't hold its temperature in about {left:.0f} flights"
    )
    full = facts["door_full_open_share"]
    door = "door position unknown" if math.isnan(full) else f"ram door full open in {100 * full:.0f} % of cruise"
    moved = f"above 5 % since {since}"
    if case.diagnosis == "HX_SUDDEN_CLOG":
        moved += f", {100 * facts['hx_fouling_step_3']:.0f} points within three flights, which wear doesn't do"
    if facts["gained"] > loss + 2.0 * sd:
        moved += f"; its last ten flights alone lie {100 * facts['gained']:.0f} % above the best ten of this unit"
    return (
        f"Conductance (hx_fouling) is {100 * loss:.1f} +- {100 * sd:.1f} % below the system model, "
        f"{loss / max(sd, 1e-6):.0f} sigma, {moved}; worn at all (above {100 * WORN:.0f} %) with probability "
        f"{_probability(loss - WORN, sd)}. Second witness: {door}. Else: a door or outlet sensor at fault, but their "
        f"checks are quiet; icing would have gone by the next flight. {waiting}."
    )


def _compressor(case: Case, since: str) -> str:
    facts = case.facts
    loss, sd = facts["loss"], facts["sd"]
    waiting = "Waiting costs compressor power and, in the end, a flow message (21-51-CCFLOW)."
    if not math.isnan(loss):
        return (
            f"Compressor efficiency (cc_efficiency_loss) is {100 * loss:.1f} +- {100 * sd:.1f} % below expectation, "
            f"{loss / max(sd, 1e-6):.0f} sigma, believed since {since}; worn at all (above {100 * WORN:.0f} %) with "
            f"probability {_probability(loss - WORN, sd)}. Else: a drifting exit temperature sensor. {waiting}"
        )
    return (
        f"Effective diameter (cc_effective_diameter_m) is {-100 * facts['shrunk']:.1f} % below this unit's own first "
        f"flights, {-facts['shrunk'] / DIAMETER_SD:.1f} sigma of a flight and summed up beyond doubt (CUSUM), believed "
        f"since {since}. Else: a drifting speed or pressure sensor, which can't be told apart while the exit "
        f"temperature is not recorded. {waiting}"
    )


def _door(case: Case, since: str) -> str:
    facts = case.facts
    stop = f"{100 * facts['stop']:.0f} %"
    if facts["kind"] == "jam":
        return (
            f"The ram door (ram_door_open) stays at {stop} from climb to descent since {since} while its controller's "
            "need changes: less than 7 sigma of its sensor's noise, on two of three flights. Else: a frozen sensor, "
            "which would not flicker. Until repaired the outlet runs warm or cold, and the door can't make up for "
            "fouling."
        )
    return (
        f"The ram door (ram_door_open) goes no further than {stop}: since {since} the outlet ran up to "
        f"{facts['excess_k']:.1f} K ({facts['excess_k'] / PEG_SD_K:.0f} sigma of a sound flight) above its target "
        "there, and on target below. Else: a fouled exchanger, which would open the door fully first. Waiting costs "
        "temperature control on hot days."
    )


def _sensor(case: Case, since: str) -> str:
    facts = case.facts
    if facts["kind"] == "dropout":
        share = f"{100 * facts['share']:.0f} %"
        return (
            f"{facts['sensor']} is empty in {share} of its readings since {since}, on two of three flights; a sound "
            f"sensor loses about 1 %. Else: a loose connector or the recorder's bus. {WITHOUT}"
        )
    if facts["kind"] == "frozen":
        return (
            f"{facts['sensor']} shows one value, or none that can be true, from climb to descent since {since}, though "
            f"what it measures moves, on two of three flights. Else: its converter or the recorder's bus. {WITHOUT}"
        )
    return (
        f"{facts['sensor']} left what physics ties it to: {facts['channel']} moved by {facts['moved']:.3g} "
        f"({facts['sigma']:.1f} sigma of the mean) since {since}, and the pattern over all cross checks fits this "
        f"sensor with probability {facts['p']:.2f}. Else: another sensor of the same checks; wear leaves them alone. "
        f"{WITHOUT}"
    )
