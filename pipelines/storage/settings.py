"""Read the settings of one fleet: small text files in its home."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from datetime import datetime
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from hdt_core.loading import parse_toml, read_text
from pipelines.storage.files import replacing
from pipelines.storage.objects import StoreError

if TYPE_CHECKING:
    from hdt_core.alerts.cases import Limits
    from hdt_core.components import Component

MAX_DAYS = 36_525
"""A century: more days are a typing error."""


def terms_file(home: Path) -> Path:
    """Return the path of the accepted physical terms, a name a line."""
    return home / "terms.txt"


def accepted_terms(home: Path) -> tuple[str, ...]:
    """Read the names of the accepted physical terms, sorted; none where there is no file."""
    file = terms_file(home)
    try:
        lines = read_text(file).splitlines()
    except FileNotFoundError:
        return ()
    except (OSError, ValueError) as error:
        raise StoreError(f"{file} can't be read: {error}") from None
    from hdt_core.physics.terms import TERMS

    names = sorted({line.strip() for line in lines if line.strip() and not line.startswith("#")})
    if unknown := [name for name in names if name not in TERMS]:
        raise StoreError(f"{file} has no term a line: {unknown[0]!r:.40}; there are {', '.join(sorted(TERMS))}")
    return tuple(names)


def accept_terms(home: Path, names: Iterable[str]) -> None:
    """Write the terms of the model from the next night on to `terms.txt`.

    Raises
    ------
    KeyError
        A name that the library does not have.
    """
    from hdt_core.physics.terms import TERMS

    accepted = sorted(set(names))
    for name in accepted:
        TERMS[name]
    with replacing(terms_file(home)) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in accepted), encoding="utf-8")


def read_toml(file: Path) -> dict[str, Any]:
    """Return the tables of a TOML file of the home; nothing where there is no file."""
    try:
        return parse_toml(read_text(file))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise StoreError(f"{file} can't be read: {error}") from None


def read_values(file: Path, names: Iterable[str]) -> dict[str, Any]:
    """Return what a TOML file of the home sets of some names; nothing where there is no file."""
    values = read_toml(file)
    if unknown := sorted(values.keys() - {*names}):
        raise StoreError(f"{file} has no setting {unknown[0]!r:.40}; there are {', '.join(names)}")
    return values


def dagster_settings(home: Path) -> str:
    """Return the text of the home's `dagster/dagster.yaml`; empty where there is none."""
    file = home / "dagster" / "dagster.yaml"
    try:
        return read_text(file)
    except FileNotFoundError:
        return ""
    except (OSError, ValueError) as error:
        raise StoreError(f"{file} can't be read: {error}") from None


def alert_limits(home: Path) -> "Limits":
    """Return the limits of the alert rules: the defaults, and what the operator sets in `alerts.toml`.

    Raises
    ------
    StoreError
        The file can't be read, names no limit, or a value is none: shares lie between 0 and 1, and a persistence is
        `[n, of, release]` flights.
    """
    from hdt_core.alerts.cases import Limits  # NumPy is not needed to start a command

    file = home / "alerts.toml"
    values = read_values(file, [f.name for f in fields(Limits)])
    for name, value in values.items():
        if fault := _fault_of_limit(name, value):
            raise StoreError(f"{file}: {name} is {value!r:.40} and ought to be {fault}")
    changed: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else float(v) for n, v in values.items()}
    return replace(Limits(), **changed)


def _fault_of_limit(name: str, value: Any) -> str | None:
    """Return what a value of `Limits` ought to be where it is something else."""
    if name.endswith("_persistence"):
        counts = value if isinstance(value, list) and all(type(n) is int for n in value) else []
        whole = len(counts) == 3 and 1 <= counts[0] <= counts[1] <= 1000 and 1 <= counts[2] <= 1000
        return None if whole else "[n, of, release] flights, n of at most `of`"
    most = 1000 if name in ("soon_flights", "compressor_excess", "peg_k") else 1
    number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value) and 0 < value < most
    return None if number else f"a number between 0 and {most}"


def changed_limits(home: Path) -> tuple[str, ...]:
    """Return the limits that the home sets other than the defaults, as `name = value`."""
    if not os.path.lexists(home / "alerts.toml"):
        return ()
    limits = alert_limits(home)
    values = ((f, getattr(limits, f.name)) for f in fields(limits))
    return tuple(f"{f.name} = {value}" for f, value in values if value != f.default)


class Methods(NamedTuple):
    """Estimators of one component: of its design, and of its health flight by flight."""

    design: str
    health: str


Use = Literal["design", "health"]


def chosen_methods(home: Path) -> dict[str, Methods]:
    """Return the estimators that `estimators.toml` names, by the component's code; none where there is no file.

    Raises
    ------
    StoreError
        The file can't be read, or a line names no component or no method.
    """
    file = home / "estimators.toml"
    values = read_toml(file)
    if not values:
        return {}
    from hdt_core.components import components  # neither is needed to start a command
    from hdt_core.estimation import estimators

    try:
        declared = components()
        methods = estimators()
    except ValueError as error:
        raise StoreError(f"{file}: {error}") from None
    chosen = {}
    for code, value in values.items():
        line = f"{file}: {code!r:.40} = {value!r:.80}"
        if code not in declared:
            raise StoreError(f"{line}: there is no such component, but {', '.join(declared)}; {_listed(methods)}")
        own = declared[code].estimator
        named = _named_methods(value, own)
        if named is None or not {*named} <= {*methods}:
            raise StoreError(
                f"{line}: ought to be a method or {{ design = method, health = method }}; {_listed(methods)}"
            )
        chosen[code] = named
    return chosen


def _listed(methods: Iterable[str]) -> str:
    return f"methods are {', '.join(methods)}"


def _named_methods(value: Any, declared: str) -> Methods | None:
    """Return the names in a line of `estimators.toml`, the `declared` one where it names none; None without form."""
    if isinstance(value, str):
        return Methods(value, value)
    if not isinstance(value, dict) or not value or value.keys() - {*Methods._fields}:
        return None
    names = Methods(declared, declared)._replace(**value)
    return names if all(isinstance(name, str) for name in names) else None


def by_home(component: "Component", home: Path, use: Use) -> "Component":
    """Return a component with the estimator that the home names for this use, its own where it names none."""
    chosen = chosen_methods(home).get(component.code)
    return component if chosen is None else replace(component, estimator=getattr(chosen, use))


def _changed_methods(use: Use, *, of_pack: bool) -> Callable[[Path], tuple[str, ...]]:
    """Make the reader of the estimators other than the declared ones, as `code = name`."""

    def read(home: Path) -> tuple[str, ...]:
        chosen = chosen_methods(home)
        if not chosen:
            return ()
        from hdt_core.components import components

        declared = components()
        lines = ((code, getattr(names, use)) for code, names in sorted(chosen.items()))
        is_own = ((code, name) for code, name in lines if (declared[code].record is None) == of_pack)
        return tuple(f"{use} of {code} = {name}" for code, name in is_own if name != declared[code].estimator)

    return read


HOME_SETTINGS: dict[str, Callable[[Path], tuple[str, ...]]] = {
    "terms": accepted_terms,
    "limits": changed_limits,
    "design of packs": _changed_methods("design", of_pack=True),
    "health of packs": _changed_methods("health", of_pack=True),
    "design of components": _changed_methods("design", of_pack=False),
    "health of components": _changed_methods("health", of_pack=False),
}
"""What a home sets that results depend on, by the name under which a `Recipe` lists it."""


def notify_file(home: Path) -> Path:
    """Return the path of the digest's receivers; the file is optional."""
    return home / "notify.toml"


@dataclass(frozen=True)
class Retention:
    """Days that replaced files are kept, nights that are kept beyond that, and days of Dagster's history of runs."""

    keep_days: int = 30
    hold: tuple[str, ...] = ()
    dagster_history_days: int = 90


def retention(home: Path) -> Retention:
    """Read the retention that the home declares."""
    file = home / "retention.toml"
    values = read_values(file, [f.name for f in fields(Retention)])
    nights = values.get("hold", [])
    prefixes = [night_prefix(str(n)) for n in nights] if isinstance(nights, list) else [None]
    if None in prefixes:
        raise StoreError(f"{file}: hold is {nights!r:.80} and ought to be a list of nights such as '2024-03-01'")
    hold = tuple(p for p in prefixes if p)
    return Retention(_days(file, values, "keep_days"), hold, _days(file, values, "dagster_history_days"))


def _days(file: Path, values: dict[str, Any], name: str) -> int:
    """Return a number of days, the default where the file sets none."""
    days = values.get(name, getattr(Retention, name))
    if isinstance(days, bool) or not isinstance(days, int) or not 1 <= days <= MAX_DAYS:
        raise StoreError(f"{file}: {name} is {days!r:.40} and ought to be a whole number from 1 to {MAX_DAYS}")
    return days


def night_prefix(text: str) -> str | None:
    """Return a date or time in UTC, or the first part of one, as nights are named; None where it is none.

    Examples
    --------
    >>> night_prefix("2024-03-01 02:00Z"), night_prefix("2024-03-01T02:00+02:00"), night_prefix("01.03.2024")
    ('2024-03-01T02:00', None, None)
    """
    prefix = text.replace(" ", "T").removesuffix("Z").removesuffix("+00:00")
    try:
        moment = datetime.fromisoformat(prefix + "2024-01-01T00:00"[len(prefix) :])
    except ValueError:
        return None
    return prefix if len(prefix) >= len("2024") and moment.tzinfo is None else None
