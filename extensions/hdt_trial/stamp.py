"""RFC 3161 time stamps of the log's head, by the `openssl` program: a third party attests when a digest existed.

Nothing here talks to a network: the request is a file that someone takes to a time-stamping authority, and its answer
is a file that is laid beside it.
"""

import subprocess
from pathlib import Path

from hdt_trial.declaration import TrialError
from hdt_trial.log import LogEntry


def request(folder: Path, entry: LogEntry) -> Path:
    """Write the request for an entry's digest, `<number>.tsq`; the answer belongs beside it as `<number>.tsr`."""
    target = folder / f"{entry.number:05}.tsq"
    _openssl("ts", "-query", "-digest", entry.digest, "-sha256", "-cert", "-out", str(target))
    return target


def faults(folder: Path, log: list[LogEntry], authority: Path) -> list[str]:
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
