"""The sealed log: one file an entry, each with the SHA-256 of the file before it, so that a chain of digests holds all.

Anyone can check it with `sha256sum` and a text editor: the digest of entry k is that of its file, and entry k + 1 names
it as `previous`. The last digest, the head, is also kept in `heads.txt` and printed each night. Someone who can write
here can make a whole new chain, heads included: only a digest that left the house, on paper, in a mail or under a time
stamp, reveals that: RFC 3161 stamps are made and verified by the `openssl` program. Nothing here talks to a network:
the request is a file that someone takes to a time-stamping authority, and its answer is a file that is laid beside it.
"""

import hashlib
import json
import re
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from hdt_trial.declaration import TrialError
from pipelines.storage.files import replacing

HEADS = "heads.txt"
NOTHING = "0" * 64
"""`previous` of the first entry."""
_NAME = re.compile(r"\d{5}\.json")


@dataclass(frozen=True, slots=True)
class LogEntry:
    """One sealed entry."""

    number: int
    kind: str
    sealed_at: datetime
    previous: str
    body: dict[str, Any]
    digest: str


def entries(folder: Path) -> list[LogEntry]:
    """Read the log in order, unverified; `faults` verifies it."""
    return [_read(file) for file in _files(folder)]


def append(folder: Path, kind: str, body: dict[str, Any], now: datetime) -> LogEntry:
    """Seal one more entry.

    Raises
    ------
    TrialError
        The log was altered; nothing is appended to it.
    """
    begins = kind == "start" and not any(folder.iterdir())
    if not begins and (fault := next(faults(folder, spare=1), None)):
        raise TrialError(f"the trial's log was altered: {fault}; nothing was added")
    log = entries(folder)
    previous = log[-1].digest if log else NOTHING
    record = {"number": len(log), "kind": kind, "sealed_at": now.isoformat(), "previous": previous, "body": body}
    path = folder / f"{len(log):05}.json"
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False, ensure_ascii=False) + "\n", "utf-8")
    entry = _read(path)
    heads = [*(e.digest for e in log), entry.digest]
    with replacing(folder / HEADS) as temporary:
        temporary.write_text("".join(f"{n:05} {digest}\n" for n, digest in enumerate(heads)), "utf-8")
    return entry


def faults(folder: Path, digests: Iterable[str] = (), head: str | None = None, *, spare: int = 0) -> Iterator[str]:
    """Yield the signs that the log was altered after it was sealed.

    Parameters
    ----------
    folder : Path
        The log.
    digests : iterable of str
        Heads printed on earlier nights and stored elsewhere: each must be in the chain.
    head : str, optional
        Head printed last: the chain must end with it.
    spare : int
        Entries allowed without a line in `heads.txt`: a kill between the two writes leaves one.
    """
    files = _files(folder)
    previous = NOTHING
    before = None
    chain = []
    if not files:
        yield f"no entry in {folder}"
    for number, file in enumerate(files):
        if file.name != f"{number:05}.json":
            yield f"entry {number} is missing"
            return
        try:
            entry = _read(file)
        except TrialError as error:
            yield str(error)
            return
        if entry.number != number or entry.previous != previous:
            yield f"entry {number} does not follow the one before it"
            return
        if before and entry.sealed_at < before:
            yield f"entry {number} is older than the one before it"
        previous = entry.digest
        before = entry.sealed_at
        chain.append(entry.digest)
    yield from _of_heads(folder / HEADS, chain, spare)
    if head and chain[-1] != head.lower():
        yield f"the last entry does not have the digest {head[:16]}... that was given"
    for digest in digests:
        if digest.lower() not in chain:
            yield f"the digest {digest[:16]}... that was given is not in the log"


def _of_heads(file: Path, chain: list[str], spare: int) -> Iterator[str]:
    lines = file.read_text("utf-8", errors="replace").splitlines() if file.is_file() else []
    expected = [f"{n:05} {digest}" for n, digest in enumerate(chain)]
    if lines == expected or (spare and expected[:-spare] == lines):
        return
    differs = next((n for n, (a, b) in enumerate(zip(lines, expected, strict=False)) if a != b), None)
    if differs is not None:
        yield f"entry {differs} is not the one whose digest {file.name} holds"
    elif len(lines) > len(expected):
        yield f"{len(lines) - len(expected)} entries were removed at the end: {file.name} holds {len(lines)}"
    else:
        yield f"{len(expected) - len(lines)} entries at the end are not in {file.name}"


def _files(folder: Path) -> list[Path]:
    return sorted(f for f in folder.glob("*.json") if _NAME.fullmatch(f.name))


def _read(file: Path) -> LogEntry:
    data = file.read_bytes()
    try:
        record = json.loads(data)
        at = datetime.fromisoformat(record["sealed_at"])
        digest = hashlib.sha256(data).hexdigest()
        return LogEntry(int(record["number"]), record["kind"], at, record["previous"], dict(record["body"]), digest)
    except (ValueError, KeyError, TypeError):
        raise TrialError(f"{file.name} is not a valid entry") from None


def stamp_request(folder: Path, entry: LogEntry) -> Path:
    """Write the request for an entry's digest, `<number>.tsq`; the answer belongs beside it as `<number>.tsr`."""
    target = folder / f"{entry.number:05}.tsq"
    _openssl("ts", "-query", "-digest", entry.digest, "-sha256", "-cert", "-out", str(target))
    return target


def stamp_faults(folder: Path, log: list[LogEntry], authority: Path) -> list[str]:
    """List the stamps that fail verification.

    Parameters
    ----------
    folder : Path
        The log, with the answers `<number>.tsr`.
    log : list of LogEntry
        Its entries.
    authority : Path
        The authority's certificate, PEM.
    """
    messages = []
    for answer in stamps(folder):
        number = int(answer.stem) if answer.stem.isdecimal() else len(log)
        if number >= len(log):
            messages.append(f"{answer.name} belongs to no entry")
            continue
        try:
            _openssl("ts", "-verify", "-digest", log[number].digest, "-in", str(answer), "-CAfile", str(authority))
        except TrialError:
            messages.append(f"{answer.name} does not match entry {number}")
    return messages


def stamps(folder: Path) -> list[Path]:
    """List the replies stored beside the log."""
    return sorted(folder.glob("*.tsr"))


def _openssl(*arguments: str) -> None:
    try:
        done = subprocess.run(["openssl", *arguments], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        raise TrialError("time stamps need the program openssl, which is not installed") from None
    if done.returncode:
        raise TrialError(f"openssl: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
