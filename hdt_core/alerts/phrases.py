"""Phrases that diagnoses share, and plain names of signals and cross checks."""

from hdt_core.alerts.text import Column, Phrase, Text

WITHIN = Phrase("{value} % ({low} to {high})")
ABOVE = Phrase("above {value}")
TREND = Phrase("{points} points more every ten flights (trend of 30)")
UPSTREAM = Phrase(
    "Find the cause upstream before another unit goes on (number {units} here in {days} days): ram inlet and "
    "duct, the air it is fed (bleed, filter), flow and temperature control, its sensors"
)
THEN = Phrase(". Only then: ")
NAMED = Phrase("{name}{column}")

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
    return Text(NAMED, name=Text.whole((SIGNALS | CHECKS)[code]), column=Column(code))
