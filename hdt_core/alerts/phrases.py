"""Phrases of evidence, each declared once with its values as `{name}`, and plain names of signals and cross checks.

Translations cover all of `PHRASES`. A value is a number, a name or another phrase; a field that is a column of the
catalog, such as `{hx_fouling}`, stands for its name in parentheses.
"""

from hdt_core.alerts.text import Column, Text

UA_LOST = (
    "Heat transfer lost{hx_fouling} {loss}, {sigma} times its uncertainty; above {limit} % since {since}, and with "
    "probability {odds}"
)
WITHIN = "{value} % ({low} to {high})"
ABOVE = "above {value}"
TREND = "{points} points more every ten flights (trend of 30)"
RISE = "its last ten flights alone lost {points} points more than its ten best"
EXCHANGER_ELSE = "a door or outlet sensor at fault, if an alert of its own is open; icing would go by the next flight"
EXCHANGER_COSTS = "Waiting costs ram drag and, when the door has no travel left, the message 21-52-HXTEMP"
JUMP = "{points} points of it within three flights, which wear doesn't do"
DOOR_UNKNOWN = "door position unknown"
DOOR_SPARE = "ram door full open in {share} % of cruise: it can still make up for the loss"
DOOR_FULL = "ram door full open in {share} % of cruise"
DOOR_ALIKE = "ram door about as wide as that of the other pack, which has lost less"
DOOR_WIDER = "ram door {points} points wider than that of the other pack"
DOOR_NARROWER = "ram door {points} points narrower than that of the other pack, which has lost less"
OTHER_LESS = "the other pack has lost {points} points less on the same flights"
OTHER_ALIKE = "the other pack has lost as much: the same dust, or an error both share"
FLOW_BLOCKED = "ram flow {share} % below a clean duct's, as a blocked core has it"
FLOW_CLEAN = "ram flow that of a clean duct: no blockage"

MARGIN = (
    "With the ram door full open the outlet would stand {margin} its level in the hottest fifth of the last flight, "
    "{hot_day} it on a hot day (ISA + 15 K); message 21-52-HXTEMP within 300 flights with probability {odds} by "
    "physics alone, likely since {since}"
)
BELOW_BY = "{k} below"
ABOVE_BY = "{k} above"
FAR_UNKNOWN = "at an unknown distance from"
MARGIN_PARTS = "what makes the margin: {parts}"
BY_DESIGN, BY_TARGET, BY_FLOW = "the design gives {k}", "target {k}", "flow {k}"
BY_AIR, BY_WEAR = "air outside {k}", "wear and build {k}"
NOT_WEAR_ALONE = "Heat transfer lost{hx_fouling} {loss}: wear alone does not explain it"
WARM_OUTLET = "on the last flight the outlet was {k} above its level, door full open"
MARGIN_ELSE = "a cooler season, or an outlet sensor that reads high"
MARGIN_COSTS = "Waiting costs the message on a hot day, and an exchanger that is taken off in vain"

COMPRESSOR = (
    "Compressor efficiency{cc_efficiency_loss} lost {loss} against expectation, {sigma} times its uncertainty, "
    "likely since "
    "{since}; worn at all (above {limit} %) with probability {odds}"
)
COMPRESSOR_ELSE = "a drifting exit temperature sensor"
COMPRESSOR_COSTS = "Waiting costs compressor power and, in the end, a flow message (21-51-CCFLOW)"
SMALLER_DIAMETER = (
    "Effective diameter{cc_effective_diameter_m} is {share} % below this unit's own first flights, {sigma} times the "
    "scatter of a flight and summed up beyond doubt (CUSUM), likely since {since}"
)
NO_EFFICIENCY = "no efficiency to compare with: the exit temperature is not recorded"
SMALLER_DIAMETER_ELSE = "a drifting speed or pressure sensor"
DIAMETER_LOST = "effective diameter lost{cc_diameter_loss} {share} %"
DIAMETER_LEFT = (
    "{share} % more of it{cc_diameter_left} may go before the flow of the last flight is no longer delivered"
)
TOO_SMALL = "at its highest speed {share} % too small{cc_diameter_left} for the flow of the last flight"
LEFT_HOT_HIGH = "at 41,000 ft on a hot day, ISA + 15 K, {share} % may go{cc_diameter_left_hot_high}"
SMALL_HOT_HIGH = "at 41,000 ft on a hot day, ISA + 15 K, it is {share} % too small{cc_diameter_left_hot_high}"

JAM = (
    "The ram door{ram_door_open} stays at {stop} % from climb to descent since {since} while its controller's need "
    "changes: less than 7 times its sensor's noise, on two of three flights"
)
FLICKERS = "its reading flickers, which that of a frozen sensor would not"
JAM_ELSE = "a frozen sensor"
JAM_COSTS = "Until repaired the outlet runs warm or cold, and the door can't make up for fouling"
SHORT_TRAVEL = (
    "The ram door{ram_door_open} goes no further than {stop} %: since {since} the outlet ran up to {k} ({sigma} "
    "times the scatter of a sound flight) above its target there"
)
ON_TARGET = "the outlet was on target wherever the door was not at that stop"
SHORT_TRAVEL_ELSE = "a fouled exchanger, which would open the door fully first"
SHORT_TRAVEL_COSTS = "Waiting costs temperature control on hot days"

DROPOUT = (
    "{sensor} is empty in {share} % of its readings since {since}, on two of three flights; a sound sensor loses about "
    "1 %"
)
DROPOUT_ELSE = "a loose connector or the recorder's bus"
FROZEN = (
    "{sensor} shows one value, or none that can be true, from climb to descent since {since}, though what it measures "
    "moves, on two of three flights"
)
FROZEN_ELSE = "its converter or the recorder's bus"
SENSOR_SHIFT = (
    "{sensor} left what physics ties it to: {check} moved by {moved} ({sigma} times its uncertainty) since {since}"
)
SENSOR_FITS = "the pattern over all cross checks fits this sensor with probability {odds}"
BOTH_SENSORS = "on the other pack the same sensor moved with it: one change of scale, map or software, not two faults"
SENSOR_ELSE = "another sensor of the same checks; wear leaves them alone"
SENSOR_COSTS = "Until it is replaced the pack's health is judged without it, and less surely"
SENSOR_NAMED = "; sensor: {sensor}"
BOTH_NAMED = "; but {sensor} changed on both packs at once: look at the recorder's scale, map and software first"

UPSTREAM = (
    "Find the cause upstream before another unit goes on (number {units} here in {days} days): ram inlet and "
    "duct, the air it is fed (bleed, filter), flow and temperature control, its sensors"
)
THEN = ". Only then: "
COMPARE = (
    "; found clean on {day}, so neither wash nor new part yet: compare what the loss stands on with the other pack's "
    "on one flight; where all agree, wash, for a film inside is not seen from outside"
)
_GROWTH = "was found clean on {day} at a loss of {level} %, and the loss has grown to {loss} % since {since}"
FOUND_CLEAN = {
    "HX": f"The heat exchanger {_GROWTH}: check the sensors it stands on (inlet and outlet temperature of the "
    "exchanger, pack flow, total air temperature)",
    "CC": f"The compressor {_GROWTH}: check the sensors it stands on (temperatures and pressures at its inlet and "
    "exit)",
}
CLEAN_LOSES_NOTHING = "the inspection: a clean part loses nothing more"
CLEAN_ELSE = "a film that the inspection could not see, or dust since"

NAMED = "{name}{column}"
UNIT_LOST = (
    "{lost}{name} {loss}, {sigma} times its uncertainty; above {limit} % since {since}, and with probability {odds}"
)
UNIT_FAILS = "it fails at about {loss}"
UNIT_STEP = "{points} points came within three flights: a sudden event"

PHRASES: tuple[str, ...] = tuple(
    text
    for name, value in globals().items()
    if name[0].isupper() and name.isupper()
    for text in (value.values() if isinstance(value, dict) else [value])
)

SIGNALS = {
    "altitude_m": "pressure altitude",
    "mach": "Mach number",
    "tat_k": "total air temperature",
    "total_pressure_pa": "total air pressure",
    "hx_in_k": "inlet temperature of the exchanger",
    "hx_out_k": "outlet temperature of the exchanger",
    "ram_door_open": "ram door position",
    "pack_flow_kg_s": "pack flow",
    "ram_out_k": "ram air temperature behind the exchanger",
    "cc_speed_rad_s": "compressor speed",
    "cc_in_k": "compressor inlet temperature",
    "cc_in_pa": "compressor inlet pressure",
    "cc_out_k": "compressor exit temperature",
    "cc_out_pa": "compressor exit pressure",
    "cc_flow_kg_s": "compressor flow",
    "vda_counts": "diffuser position",
}
"""Signals of the recorder in plain words."""
CHECKS = {
    "inlet_minus_tat_k": "compressor inlet against total air temperature",
    "inlet_over_total_pressure_ln": "compressor inlet against total air pressure",
    "total_over_pitot_pressure_ln": "total air pressure against speed and altitude",
    "pack_over_compressor_flow_ln": "pack flow against compressor flow",
    "tat_between_packs_k": "total air temperature between the packs",
    "total_pressure_between_packs_ln": "total air pressure between the packs",
    "pack_flow_between_packs_ln": "pack flow between the packs",
    "compressor_flow_between_packs_ln": "compressor flow between the packs",
    "cc_out_pressure_between_packs_ln": "compressor exit pressure between the packs",
    "cc_out_pressure_over_schedule_ln": "compressor exit pressure against its schedule",
    "hx_out_minus_target_k": "outlet temperature against its target",
    "hx_out_between_packs_k": "outlet temperature between the packs",
    "hx_in_over_discharge_k": "inlet temperature of the exchanger against the compressor's exit",
    "hx_in_over_pressure_k": "inlet temperature of the exchanger against the pressure ratio",
    "conductance_off_cruise_ln": "conductance in climb and descent against cruise",
}
"""Cross checks of sensors."""


def plain_name(code: str) -> Text:
    """Return the plain name of a signal or cross check, with its name in the catalog.

    Examples
    --------
    >>> plain_name("hx_out_k")
    'outlet temperature of the exchanger (hx_out_k)'
    """
    return Text(NAMED, name=Text((SIGNALS | CHECKS)[code]), column=Column(code))
