"""The ledger's hash as the last night left it, by which damage is noticed; and a copy, by which it is mended.

While `ledger.sealed` holds the hash nobody has written to the ledger since, so it must be the same; else SQLite itself
is asked. The copy, whose name holds its own hash, is that of the last night that made something. A database server
looks after its own.
"""

from pathlib import Path

from pipelines.storage import sqlite_reader
from pipelines.storage.data_file import hash_of
from pipelines.storage.files import private, replacing
from pipelines.storage.ledger import Ledger
from pipelines.storage.ledger_tables import FILE, SEALED


def keep_copy(ledger: Ledger, *, idle: bool = False) -> None:
    """Copy the ledger as it is now and seal it; an `idle` night only noted that it was, and the copy there will do."""
    path, sealed = ledger.home / FILE, ledger.home / SEALED
    if ledger.url or not path.exists():
        return
    sealed.write_text("")  # it goes when someone writes; killed before the hash stands in it, it says nothing
    ledger.flush()
    content = path.read_bytes()
    found = hash_of(content)
    copy = ledger.home / f"ledger.{found}.copy"
    if kept := not (idle and _copies(ledger.home)):
        with replacing(copy) as temporary:
            private(temporary).write_bytes(content)
    whole = sealed.exists()  # or someone has written meanwhile
    if whole:
        _seal(ledger.home, found)
    for other in _copies(ledger.home) if kept else ():
        if (other != copy) == whole:
            other.unlink()


def _seal(home: Path, found: str) -> None:
    with replacing(home / SEALED) as temporary:
        temporary.write_text(found)


def fault_of(ledger: Ledger) -> str | None:
    """What is wrong with the ledger; None where it is whole, or where there is none yet."""
    path, copies = ledger.home / FILE, _copies(ledger.home)
    if ledger.url or not (path.exists() or copies):
        return None
    if not path.exists():
        return "is gone"
    sealed = ledger.home / SEALED
    if sealed.exists() and (wanted := sealed.read_text(errors="replace")):
        return None if hash_of(path.read_bytes()) == wanted else "is not what the last night wrote"
    # SQLite's quick check takes columns of a table without rowid for empty where their order is not the key's (3.40)
    said = sqlite_reader.says(path, "pragma integrity_check(1)")
    return None if said == "ok" else f"is damaged ({said})"


def mend(ledger: Ledger) -> str | None:
    """Put the last copy in the place of a ledger that is damaged; what was wrong, in words."""
    fault = fault_of(ledger)
    if fault is None:
        return None
    for left in ledger.home.glob(f"{FILE}*"):
        left.unlink()
    for copy in _copies(ledger.home):
        content = copy.read_bytes()
        if hash_of(content) == _hash_in(copy):
            with replacing(ledger.home / FILE) as temporary:
                private(temporary).write_bytes(content)
            _seal(ledger.home, _hash_in(copy))
            return f"the ledger {fault}; the copy of the last night's end takes its place"
    return f"the ledger {fault}; all that lies in the landing zone is taken in again"


def _copies(home: Path) -> list[Path]:
    return sorted(home.glob("ledger.*.copy"), key=lambda copy: copy.stat().st_mtime_ns, reverse=True)


def _hash_in(copy: Path) -> str:
    return copy.name.split(".")[1]
