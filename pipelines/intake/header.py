"""Match the column names of a file with those of the contract."""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from difflib import SequenceMatcher
from functools import lru_cache

from pipelines.intake.columns import Contract
from pipelines.intake.faults import Fault

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
