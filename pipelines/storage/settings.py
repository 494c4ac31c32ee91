"""What an engineer sets for one fleet: small text files in its home."""

from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path

from hdt_core.toml_text import parse_toml
from pipelines.storage.objects import StoreError

MOST_DAYS = 36_525
"""A century: days beyond it are a slip of the keyboard."""


def terms_file(home: Path) -> Path:
    """Where the accepted physical terms stand, a name a line."""
    return home / "terms.txt"


def accepted_terms(home: Path) -> tuple[str, ...]:
    """Names of the accepted physical terms, sorted; none where there is no file."""
    file = terms_file(home)
    if not file.exists():
        return ()
    from hdt_core.physics.terms import TERMS

    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"{file} can't be read: {error}") from None
    names = sorted({line.strip() for line in lines if line.strip() and not line.startswith("#")})
    if unknown := [name for name in names if name not in TERMS]:
        raise StoreError(f"{file} has no term a line: {unknown[0]!r:.40}; there are {', '.join(sorted(TERMS))}")
    return tuple(names)


def notify_file(home: Path) -> Path:
    """Where it is declared who is told of what a night changed; none need be there."""
    return home / "notify.toml"


@dataclass(frozen=True)
class Retention:
    """How long what was replaced stays, and which nights stay beyond that."""

    keep_days: int = 30
    hold: tuple[str, ...] = ()


def retention(home: Path) -> Retention:
    """What the home declares."""
    file = home / "retention.toml"
    if not file.exists():
        return Retention()
    try:
        given = {"keep_days": 30, "hold": []} | parse_toml(file.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise StoreError(f"{file} can't be read: {error}") from None
    if unknown := sorted(set(given) - {"keep_days", "hold"}):
        raise StoreError(f"{file} holds keep_days and hold, not {unknown[0]}")
    days, nights = given["keep_days"], given["hold"]
    if isinstance(days, bool) or not isinstance(days, int) or not 1 <= days <= MOST_DAYS:
        raise StoreError(f"{file}: keep_days is {days!r:.40} and ought to be a whole number from 1 to {MOST_DAYS}")
    nights = [str(n) if isinstance(n, date) else n for n in nights] if isinstance(nights, list) else nights
    if not isinstance(nights, list) or not all(map(_is_night, nights)):
        raise StoreError(f"{file}: hold is {nights!r:.80} and ought to be a list of nights such as '2024-03-01'")
    return Retention(days, tuple(nights))


def _is_night(text: object) -> bool:
    """Whether a text is a date, or a time, as `hdt query --as-of` takes them."""
    try:
        return isinstance(text, str) and datetime.fromisoformat(text) is not None
    except ValueError:
        return False
