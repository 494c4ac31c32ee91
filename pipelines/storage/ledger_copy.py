"""Copy the ledger at a night's end, and put the copy in the place of a damaged one.

While `ledger.sealed` holds the ledger's hash nobody has written to it since, so it must match; otherwise SQLite checks
the file. The copy, whose name holds its own hash, is that of the last night that made something. A database server has
checks and copies of its own.
"""

from pathlib import Path

from pipelines.storage.database import query_value
from pipelines.storage.files import hash_of, make_private, replacing
from pipelines.storage.ledger import FILE, HASH_FILE, Ledger


def copy_ledger(ledger: Ledger, *, idle: bool = False) -> None:
    """Copy the ledger and write its hash; after an `idle` night an existing copy will do."""
    path = ledger.home / FILE
    hash_file = ledger.home / HASH_FILE
    if ledger.url or not path.exists():
        return
    hash_file.write_text("")  # every writer removes it; empty, after a kill, it counts as none
    ledger.flush()
    content = path.read_bytes()
    hash_ = hash_of(content)
    copy = ledger.home / f"ledger.{hash_}.copy"
    if new_copy := not (idle and _copies(ledger.home)):
        with replacing(copy) as temporary:
            make_private(temporary).write_bytes(content)
    whole = hash_file.exists()  # otherwise someone has written meanwhile
    if whole:
        _write_hash(ledger.home, hash_)
    for other in _copies(ledger.home) if new_copy else ():
        if (other != copy) == whole:
            other.unlink()


def _write_hash(home: Path, hash_: str) -> None:
    with replacing(home / HASH_FILE) as temporary:
        temporary.write_text(hash_)


def find_ledger_fault(ledger: Ledger) -> str | None:
    """Check the ledger; the fault in words, None where it is whole or where there is none yet."""
    path = ledger.home / FILE
    copies = _copies(ledger.home)
    if ledger.url or not (path.exists() or copies):
        return None
    if not path.exists():
        return "is gone"
    hash_file = ledger.home / HASH_FILE
    if hash_file.exists() and (expected_hash := hash_file.read_text(errors="replace")):
        return None if hash_of(path.read_bytes()) == expected_hash else "is not what the last night wrote"
    # SQLite's quick check takes columns of a table without rowid for empty where their order is not the key's (3.40)
    answer = query_value(path, "pragma integrity_check(1)")
    return None if answer == "ok" else f"is damaged ({answer})"


def repair_ledger(ledger: Ledger) -> str | None:
    """Replace a damaged ledger by its last copy; the fault in words."""
    fault = find_ledger_fault(ledger)
    if fault is None:
        return None
    for file in ledger.home.glob(f"{FILE}*"):
        file.unlink()
    for copy in _copies(ledger.home):
        content = copy.read_bytes()
        if hash_of(content) == _hash_in(copy):
            with replacing(ledger.home / FILE) as temporary:
                make_private(temporary).write_bytes(content)
            _write_hash(ledger.home, _hash_in(copy))
            return f"the ledger {fault}; the copy of the last night's end takes its place"
    return f"the ledger {fault}; all that lies in the landing zone is taken in again"


def _copies(home: Path) -> list[Path]:
    return sorted(home.glob("ledger.*.copy"), key=lambda copy: copy.stat().st_mtime_ns, reverse=True)


def _hash_in(copy: Path) -> str:
    return copy.name.split(".")[1]
