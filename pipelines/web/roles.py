"""Read `roles.toml` of a home: who may read or change which operators' cases on the page.

A viewer reads, an engineer also changes cases. A person with `operators` reads those operators' cases only.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipelines.storage.objects import StoreError
from pipelines.storage.settings import read_values

FILE = "roles.toml"
ROLES = ("viewer", "engineer")
_MAX_NAME = 80


@dataclass(frozen=True, slots=True)
class Person:
    """A signed-in person; an empty `operators` stands for all of them."""

    name: str
    role: str = "engineer"
    operators: tuple[str, ...] = ()

    @property
    def may_change(self) -> bool:
        """Test for a role that changes cases."""
        return self.role == "engineer"

    def may_read(self, operator: str) -> bool:
        """Test whether the person may read an operator's cases."""
        return not self.operators or operator in self.operators


def read_people(home: Path) -> dict[str, Person]:
    """Return everybody below `[people]`, by name; nobody where there is no file.

    Raises
    ------
    StoreError
        The file can't be read, or an entry is unknown or invalid; one line that names it.
    """
    return {name: _person(name, entry) for name, entry in _read_file(home)["people"].items()}


def local_person(home: Path) -> Person:
    """Return the person of the printed token: this account, an engineer unless `local` sets another role.

    Raises
    ------
    StoreError
        As `read_people`.
    """
    return _person(os.environ.get("USER", "").strip() or "local", _read_file(home)["local"])


def _read_file(home: Path) -> dict[str, Any]:
    entries = {"local": "engineer", "people": {}} | read_values(home / FILE, ("local", "people"))
    if not isinstance(entries["people"], dict):
        raise StoreError(f"{FILE}: people is a table of names; write [people] on a line of its own")
    return entries


def _person(name: str, entry: Any) -> Person:
    """Check one entry: a role, or a table of `role` and `operators`."""
    where, entry = f"{FILE}: {name!r}", entry if isinstance(entry, dict) else {"role": entry}
    if not (0 < len(name) <= _MAX_NAME and name.isprintable() and name == name.strip()):
        raise StoreError(f"{where}: a name has 1 to {_MAX_NAME} printable characters")
    if unknown := sorted(set(entry) - {"role", "operators"}):
        raise StoreError(f"{where}: unknown key {unknown[0]}; there are role and operators")
    role, operators = entry.get("role"), entry.get("operators", [])
    if role not in ROLES:
        raise StoreError(f"{where}: role is {' or '.join(ROLES)}, not {role!r}")
    if not isinstance(operators, list) or not all(isinstance(o, str) for o in operators):
        raise StoreError(f"{where}: operators is a list of texts, not {operators!r}")
    if "operators" in entry and not operators:
        raise StoreError(f"{where}: operators is empty; leave it out to allow all of them")
    return Person(name, role, tuple(operators))
