"""Whether the column names of a file are those of the contract, and what to call its columns."""

import re
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher

from pipelines.intake.ledger import Fault

_UNITS = {"ft", "degc", "psia", "pct", "lbpm", "rpm", "pos"}


@dataclass(frozen=True, slots=True)
class Header:
    """Names by position: the contract's name, or None for a column that is left aside. `fault` refuses the file."""

    names: tuple[str | None, ...] = ()
    fault: Fault | None = None
    notes: tuple[Fault, ...] = field(default=())


def judge_header(
    found: Sequence[str],
    required: Collection[str],
    optional: Collection[str],
    core: Collection[str] = (),
    extra: Collection[str] = (),
) -> Header:
    """Match the names found with those of the contract.

    Case and blanks around a name are forgiven. A required name that is missing refuses the file. An optional one may be
    missing for an operator, unless the file holds a stranger that looks like it (`T_HX_IN` for `hx_in_degc`), or two or
    more of `core` are missing and as many strangers there: then columns were renamed, and taking the rest would lose a
    sensor silently. Of `extra` names none is missed.
    """
    known = {*required, *optional, *extra}
    clean = [name.strip().strip('"').strip().lower() for name in found]
    names = tuple(name if name in known else None for name in clean)
    counts = Counter(n for n in names if n)
    strangers = [f.strip() for f, n in zip(found, names, strict=True) if n is None and f.strip()]
    missing = [n for n in (*required, *optional) if n not in counts]
    if not counts:
        is_data = any(c.isdigit() for c in "".join(clean))
        missed = ", ".join(required)
        reason = "no_header" if is_data else "missing_columns"
        return Header(fault=Fault(reason, column_name=missed, detail=f"Missing: {missed}. It reads: {_shown(found)}."))
    if repeated := [n for n, times in counts.items() if times > 1]:
        return Header(
            fault=Fault("repeated_column", column_name=", ".join(repeated), detail=f"Twice: {', '.join(repeated)}.")
        )
    lost = [n for n in required if n not in counts] or _renamed(missing, strangers, core)
    if lost or (optional and not any(n in counts for n in optional)):
        lost = lost or missing
        detail = f"Missing: {', '.join(lost)}." + (f" Not known: {_shown(strangers)}." if strangers else "")
        return Header(fault=Fault("missing_columns", column_name=", ".join(lost), detail=detail))
    notes = []
    if strangers:
        notes.append(Fault("extra_columns", column_name=_shown(strangers)))
    if any(n and n != f.strip('"') for f, n in zip(found, names, strict=True)):
        notes.append(Fault("other_spelling", detail=f"It reads: {_shown(found)}."))
    return Header(names, notes=tuple(notes))


def _renamed(missing: Sequence[str], strangers: Sequence[str], core: Collection[str]) -> list[str]:
    """Missing names that strangers seem to stand for; all that are missing as soon as one does."""
    alike = any(_looks_like(stranger, name) for stranger in strangers for name in missing)
    swapped = 2 <= sum(name in core for name in missing) <= len(strangers)
    return list(missing) if alike or swapped else []


def _looks_like(stranger: str, name: str) -> bool:
    parts = [p for p in name.split("_") if p not in _UNITS]
    found = re.split(r"[^a-z0-9]+", stranger.lower())
    whole = all(p in found for p in parts)
    return whole or SequenceMatcher(None, stranger.lower(), name).ratio() >= 0.8


def _shown(names: Sequence[str]) -> str:
    """Names for a message: printable, and cut where there are many."""
    text = ", ".join("".join(c if c.isprintable() else "?" for c in n[:40]) for n in names[:25])
    return text + (", ..." if len(names) > 25 else "")
