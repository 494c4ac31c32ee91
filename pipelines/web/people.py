"""Who may use the page of cases: names, roles and hashed passwords in `users.json` of the home, readable by its owner.

A viewer looks, an engineer changes cases, an admin does so for every operator. A person who belongs to operators sees
theirs alone.
"""

import fcntl
import hashlib
import json
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from pipelines.storage.files import kept_secret

FILE, SECRET = "users.json", ".session_secret"
ROLES = ("viewer", "engineer", "admin")
SHORTEST = 10
"""Characters of a password."""
_COST = {"n": 1 << 14, "r": 8, "p": 1}  # 16 MiB and some 50 ms a guess
_MAX_NAME = 80


class PeopleError(ValueError):
    """A name, role or password that can't be taken; says why."""


@dataclass(frozen=True, slots=True)
class Person:
    """One user; `operators` is empty for who sees all of them."""

    name: str
    role: str
    operators: tuple[str, ...]
    salt: str
    hashed: str

    @property
    def may_change(self) -> bool:
        """Whether cases may be changed."""
        return self.role in {"engineer", "admin"}

    @property
    def stamp(self) -> str:
        """Changes with role, operators and password: a session of before is over."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:32]

    def sees(self, operator: str) -> bool:
        """Whether cases of an operator may be seen."""
        return not self.operators or operator in self.operators


def people(home: Path) -> dict[str, Person]:
    """All users by name."""
    file = home / FILE
    held = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
    return {p["name"]: Person(**p | {"operators": tuple(p["operators"])}) for p in held}


def add_person(home: Path, name: str, role: str, operators: tuple[str, ...], password: str) -> None:
    """Add a user, or give one another role, operators and password.

    Raises
    ------
    PeopleError
        The name, role or password can't be taken.
    """
    if not (0 < len(name) <= _MAX_NAME and name.isprintable() and name == name.strip()):
        raise PeopleError(f"a name has 1 to {_MAX_NAME} printable characters")
    if role not in ROLES:
        raise PeopleError(f"role is {', '.join(ROLES)}, not {role}")
    if role == "admin" and operators:
        raise PeopleError("an admin sees every operator; leave --operator out")
    if len(password) < SHORTEST:
        raise PeopleError(f"a password has {SHORTEST} characters or more")
    salt = secrets.token_hex(16)
    person = Person(name, role, tuple(sorted(set(operators))), salt, _hash(password, salt))
    with _changing(home) as held:
        held[name] = person


def remove_person(home: Path, name: str) -> None:
    """Take a user out; a session that is open ends with its next request.

    Raises
    ------
    PeopleError
        There is no such user.
    """
    with _changing(home) as held:
        if name not in held:
            raise PeopleError(f"no user {name}; there are {', '.join(sorted(held)) or 'none'}")
        del held[name]


def person_of(home: Path, name: str, password: str) -> Person | None:
    """The user of this name and password; takes as long for a name that there is not."""
    person = people(home).get(name)
    hashed = _hash(password[:1000], person.salt if person else "00" * 16)
    return person if person and secrets.compare_digest(hashed, person.hashed) else None


def session_secret(home: Path) -> str:
    """What sessions are signed with; whoever may read this file in the home may be anybody."""
    return kept_secret(home / SECRET, 48)


def _hash(password: str, salt: str) -> str:
    return hashlib.scrypt(password.encode(), salt=bytes.fromhex(salt), dklen=32, maxmem=1 << 26, **_COST).hex()


@contextmanager
def _changing(home: Path) -> Iterator[dict[str, Person]]:
    """All users, written back whole; two who change them at once wait for each other."""
    with open(os.open(home / f".{FILE}.lock", os.O_WRONLY | os.O_CREAT, 0o600), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        held = people(home)
        yield held
        temporary = home / f".{FILE}.part"
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w", encoding="utf-8") as file:
            json.dump([asdict(held[name]) for name in sorted(held)], file, indent=1, ensure_ascii=False)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(home / FILE)
