"""Declare the recorder's columns (names, scale to SI, possible values) and match the names of a file with them."""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import lru_cache
from math import pi

from pipelines.intake.faults import Fault

POUND_KG = 0.45359237
PSI_PA = 6894.757293168361
ZERO_CELSIUS_K = 273.15

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
    Column("altitude_ft", "altitude_m", -2_000, 60_000, 0.3048),
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
    keys, optional = contract.keys, contract.optional
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
