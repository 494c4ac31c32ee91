"""Declare the recorder's columns (names, scale to SI, possible values) and the laws of physics that a row obeys.

The laws hold whatever the weather and the wear; their limits are those of working aircraft with a margin. On two
simulated fleets (660,000 rows: hot and cold, worn and clogged, packs off, sensors dead, drifting and spiking) each law
holds in more than 99 % of the rows.
"""

import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import lru_cache
from math import pi

import numpy as np
from numpy.typing import NDArray

from hdt_core.physics.air import standard_pressure_pa, total_to_static_pressure
from hdt_core.physics.compressor import area_diameter_tan_beta_m3, effective_diameter_m, isentropic_efficiency
from hdt_core.physics.model import Array
from hdt_core.records.units import FOOT_M, POUND_KG, PSI_PA, ZERO_CELSIUS_K
from pipelines.intake.faults import Fault

KEYS = ("flight_id", "report_time", "pack")
PHASE = "phase_code"
AIRPORTS = ("origin", "destination")
WORDS = (PHASE, *AIRPORTS)
"""Columns of text that may be missing for an operator, or empty."""


@dataclass(frozen=True, slots=True)
class Column:
    """One signal: SI value = recorded * scale + offset; a recorded value outside `low`..`high` is not stored.

    The span is what any airliner's sensor can show, noise about zero included: frozen, drifting and spiked values
    within it are stored, and assessed by flight later.
    """

    name: str
    si_name: str
    low: float
    high: float
    scale: float = 1.0
    offset: float = 0.0


SIGNAL_COLUMNS = (
    Column("altitude_ft", "altitude_m", -2_000, 60_000, FOOT_M),
    Column("mach", "mach", -0.1, 1.2),
    Column("tat_degc", "tat_k", -110, 80, offset=ZERO_CELSIUS_K),
    Column("pt_psia", "total_pressure_pa", -2, 25, PSI_PA),
    Column("hx_in_degc", "hx_in_k", -110, 350, offset=ZERO_CELSIUS_K),
    Column("hx_out_degc", "hx_out_k", -110, 280, offset=ZERO_CELSIUS_K),
    Column("ram_door_pct", "ram_door_open", -10, 110, 0.01),
    Column("pack_flow_lbpm", "pack_flow_kg_s", -20, 600, POUND_KG / 60.0),
    Column("ram_out_degc", "ram_out_k", -110, 280, offset=ZERO_CELSIUS_K),
    Column("cc_speed_rpm", "cc_speed_rad_s", -500, 120_000, pi / 30.0),
    Column("cc_in_degc", "cc_in_k", -110, 120, offset=ZERO_CELSIUS_K),
    Column("cc_in_psia", "cc_in_pa", -2, 40, PSI_PA),
    Column("cc_out_degc", "cc_out_k", -110, 400, offset=ZERO_CELSIUS_K),
    Column("cc_out_psia", "cc_out_pa", -2, 100, PSI_PA),
    Column("cc_flow_lbpm", "cc_flow_kg_s", -20, 600, POUND_KG / 60.0),
    Column("vda_pos", "vda_counts", -100, 70_000),
)
SIGNAL_NAMES = tuple(c.name for c in SIGNAL_COLUMNS)
"""Any of these may be missing for an operator; the keys may not."""
CORE_NAMES = SIGNAL_NAMES[:8]
"""Signals that nearly every operator records; two missing and as many unknown names mean renamed columns."""
SI_NAMES = tuple(c.si_name for c in SIGNAL_COLUMNS)


@dataclass(frozen=True, slots=True)
class Contract:
    """Columns of a kind of file."""

    keys: tuple[str, ...]
    """Required columns."""
    words: tuple[str, ...] = ()
    numbers: tuple[str, ...] = ()
    """Columns of numbers; of these and `words` any but a key may be missing."""
    core: tuple[str, ...] = ()
    """Columns that nearly every file has."""
    extra: tuple[str, ...] = ()
    """Columns whose absence is never a sign of renaming."""

    @property
    def optional(self) -> tuple[str, ...]:
        """Columns that may be missing, unless they seem renamed."""
        return tuple(n for n in (*self.words, *self.numbers) if n not in self.keys)


PACK_FILES = Contract(KEYS, WORDS, ("pack", *SIGNAL_NAMES), CORE_NAMES)
"""Files of the pack by the data contract."""


_UNITS = {"ft", "degc", "psia", "pct", "lbpm", "rpm", "pos"}


@dataclass(frozen=True, slots=True)
class Header:
    """Names by position: the contract's name, or None for an ignored column. `fault` rejects the file."""

    names: tuple[str | None, ...] = ()
    fault: Fault | None = None
    notes: tuple[Fault, ...] = ()


@lru_cache(maxsize=256)  # thousands of files share a few headers
def match_header(names_of_file: tuple[str, ...], contract: Contract) -> Header:
    """Match the names in a file with those of the contract.

    Case and blanks around a name are ignored. A required name that is missing rejects the file. An optional one may be
    missing for an operator, unless the file holds an unknown name that looks like it (`T_HX_IN` for `hx_in_degc`), or
    two or more of the core are missing beside as many unknown names: then columns were renamed, and reading the others
    would lose a sensor silently.
    """
    keys = contract.keys
    optional = contract.optional
    contract_names = {*keys, *optional, *contract.extra}
    clean = [name.strip().strip('"').strip().lower() for name in names_of_file]
    names = tuple(name if name in contract_names else None for name in clean)
    counts = Counter(n for n in names if n)
    unknown_names = [f.strip() for f, n in zip(names_of_file, names, strict=True) if n is None and f.strip()]
    missing = [n for n in (*keys, *optional) if n not in counts]
    if not counts:
        is_data = any(c.isdigit() for c in "".join(clean))
        reason = "no_header" if is_data else "missing_columns"
        detail = f"Missing: {', '.join(keys)}. It reads: {_join_names(names_of_file)}."
        return Header(fault=Fault(reason, column_name=", ".join(keys), detail=detail))
    if duplicates := [n for n, times in counts.items() if times > 1]:
        twice = ", ".join(duplicates)
        return Header(fault=Fault("repeated_column", column_name=twice, detail=f"Twice: {twice}."))
    absent = [n for n in keys if n not in counts] or _renamed_columns(missing, unknown_names, contract.core)
    if absent or (optional and not any(n in counts for n in optional)):
        absent = absent or missing
        detail = f"Missing: {', '.join(absent)}." + (
            f" Not known: {_join_names(unknown_names)}." if unknown_names else ""
        )
        return Header(fault=Fault("missing_columns", column_name=", ".join(absent), detail=detail))
    notes = []
    if unknown_names:
        notes.append(Fault("extra_columns", column_name=_join_names(unknown_names)))
    if any(n and n != f.strip('"') for f, n in zip(names_of_file, names, strict=True)):
        notes.append(Fault("other_spelling", detail=f"It reads: {_join_names(names_of_file)}."))
    return Header(names, notes=tuple(notes))


def _renamed_columns(missing: Sequence[str], unknown_names: Sequence[str], core: Collection[str]) -> list[str]:
    """Return all missing names as soon as an unknown name seems to stand for one of them."""
    similar = any(_looks_like(unknown, name) for unknown in unknown_names for name in missing)
    n_core = sum(name in core for name in missing)
    return list(missing) if similar or 2 <= n_core <= len(unknown_names) else []


def _looks_like(unknown: str, name: str) -> bool:
    parts = [p for p in name.split("_") if p not in _UNITS]
    parts_of_unknown = re.split(r"[^a-z0-9]+", unknown.lower())
    whole = all(p in parts_of_unknown for p in parts)
    return whole or SequenceMatcher(None, unknown.lower(), name).ratio() >= 0.8


def _join_names(names: Sequence[str]) -> str:
    """Format names for a message: printable, and cut where there are many."""
    text = ", ".join("".join(c if c.isprintable() else "?" for c in n[:40]) for n in names[:25])
    return text + (", ..." if len(names) > 25 else "")


Signals = Mapping[str, Array]
"""SI name: values, NaN where missing."""
MIN_PRESSURE_RATIO = 1.25
"""Pressure ratio above which a compressor is surely at work."""
MIN_FLOW_KG_S = 0.04
"""Flow below which a pack is off."""


@dataclass(frozen=True, slots=True)
class Law:
    """One demand; its value is NaN where a row lacks a signal."""

    name: str
    value: Callable[[Signals], Array]
    low: float
    high: float


def _difference(one: str, other: str) -> Callable[[Signals], Array]:
    return lambda s: s[one] - s[other]


def _ratio(one: str, other: str) -> Callable[[Signals], Array]:
    return lambda s: s[one] / s[other]


def _at_work(s: Signals, value: Array) -> Array:
    return np.where(s["cc_out_pa"] > MIN_PRESSURE_RATIO * s["cc_in_pa"], value, np.nan)


def _diameter_m(s: Signals) -> Array:
    return _at_work(s, effective_diameter_m(s["cc_in_pa"], s["cc_out_pa"], s["cc_in_k"], s["cc_speed_rad_s"]))


def _efficiency(s: Signals) -> Array:
    return _at_work(s, isentropic_efficiency(s["cc_in_pa"], s["cc_out_pa"], s["cc_in_k"], s["cc_out_k"]))


def _group_m3(flow: str) -> Callable[[Signals], Array]:
    return lambda s: _at_work(s, area_diameter_tan_beta_m3(s[flow], s["cc_in_pa"], s["cc_in_k"], s["cc_speed_rad_s"]))


def _flow_ratio(s: Signals) -> Array:
    both = (s["pack_flow_kg_s"] > MIN_FLOW_KG_S) & (s["cc_flow_kg_s"] > MIN_FLOW_KG_S)
    return np.where(both, s["pack_flow_kg_s"] / s["cc_flow_kg_s"], np.nan)


def _ram_effectiveness(s: Signals) -> Array:
    """Ram air's temperature rise over the difference of the inlet temperatures. [-]"""
    difference = s["hx_in_k"] - s["tat_k"]
    return np.where(difference > 40.0, (s["ram_out_k"] - s["tat_k"]) / difference, np.nan)


def pressure_over_atmosphere(s: Signals) -> Array:
    """Total pressure over that of the standard atmosphere at the altitude and Mach number. [-]"""
    static = standard_pressure_pa(np.clip(s["altitude_m"], -1000.0, 20000.0))
    return s["total_pressure_pa"] / (static * total_to_static_pressure(np.clip(s["mach"], 0.0, 1.0)))


HIGHEST = {
    "tat_k": 423.15, "cc_in_k": 423.15, "hx_out_k": 493.15, "ram_out_k": 493.15, "hx_in_k": 563.15, "cc_out_k": 533.15,
    "total_pressure_pa": 23.5 * PSI_PA, "cc_in_pa": 23.5 * PSI_PA, "cc_out_pa": 75.0 * PSI_PA,
}  # fmt: skip
"""Limits that no air in the pack reaches: outside it stays below 80 °C, behind the exchanger below 200 °C, its total
pressure below 23.5 psia; in kelvin and, up to 45,000 ft, in kPa it reads above that."""


def _of(signal: str) -> Callable[[Signals], Array]:
    return lambda s: s[signal]


LAWS = (
    Law("the exchanger cools", _difference("hx_in_k", "hx_out_k"), -5.0, 160.0),
    Law("the compressor heats", _difference("cc_out_k", "cc_in_k"), -8.0, 215.0),
    Law("the compressor compresses", _ratio("cc_out_pa", "cc_in_pa"), 0.93, 4.6),
    Law("the compressor's inlet has the temperature outside", _difference("tat_k", "cc_in_k"), -6.5, 6.5),
    Law("the compressor's inlet has the pressure outside", _ratio("cc_in_pa", "total_pressure_pa"), 0.8, 1.08),
    Law("altitude, Mach and pressure are of one atmosphere", pressure_over_atmosphere, 0.9, 1.1),
    Law("an airliner stays below the speed of sound", _of("mach"), -0.1, 1.2),
    Law("a pressure ratio needs a speed", _diameter_m, 0.115, 0.205),
    Law("a temperature rise needs a pressure ratio", _efficiency, 0.5, 0.88),
    Law("a speed moves a volume of air", _group_m3("cc_flow_kg_s"), 5.8e-4, 1.3e-3),
    Law("a speed moves a volume of air into the pack", _group_m3("pack_flow_kg_s"), 5.6e-4, 1.3e-3),
    Law("what enters the compressor leaves the pack", _flow_ratio, 0.75, 1.33),
    Law("the exchanger's inlet is near the compressor's exit", _difference("hx_in_k", "cc_out_k"), -10.0, 88.0),
    Law("the exchanger's inlet is bleed air", _of("hx_in_k"), 293.0, 461.0),
    Law("the exchanger's exit is near the air outside", _difference("hx_out_k", "tat_k"), -30.0, 80.0),
    Law("ram air stays colder than bleed air", _difference("hx_in_k", "ram_out_k"), -5.0, 160.0),
    Law("ram air is heated part of the way", _ram_effectiveness, 0.15, 0.85),
    Law("a door is never shut in flight", _of("ram_door_open"), 0.015, 1.1),
    *(
        Law(f"{signal} is below what any air of a pack reaches", _of(signal), -np.inf, high)
        for signal, high in HIGHEST.items()
    ),
)


def law_values(signals: Signals) -> Array:
    """Evaluate each law in each row; NaN where a signal is missing. (laws, rows)"""
    with np.errstate(all="ignore"):
        return np.stack([law.value(signals) for law in LAWS])


def violations(values: Array) -> NDArray[np.bool_]:
    """Return whether values of `law_values` violate their law. (laws, rows)"""
    low, high = (np.array([[getattr(law, side)] for law in LAWS]) for side in ("low", "high"))
    return (values < low) | (values > high)
