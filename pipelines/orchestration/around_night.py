"""What stands around a night: the lock of its home before it, hooks of packages and the digest's receivers after it."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import entry_points
from pathlib import Path

from pipelines.storage import postgres
from pipelines.storage.files import narrow_umask
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import notify_file


class BusyError(Exception):
    """Another run holds this home."""


@contextmanager
def holding(home: Path) -> Iterator[None]:
    """Be the only writer of `home` and, where the fleet's ledger is a database, of the fleet.

    The lock goes with the process, however it ends.
    """
    home.mkdir(parents=True, exist_ok=True)
    with _closed_to_others(home), open(home / ".lock", "a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise BusyError(_busy(f"process {lock.read().strip() or 'unknown'}", str(home))) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        url = Ledger(home).url
        with postgres.fleet_lock(url) if url else nullcontext() as other:
            if other:
                raise BusyError(_busy(other, "this fleet"))
            yield


@contextmanager
def _closed_to_others(home: Path) -> Iterator[None]:
    """Keep from others than the group what lies in the home, and what is made in it."""
    before = narrow_umask()
    try:
        with suppress(PermissionError):  # a volume that is another's
            home.chmod(home.stat().st_mode & ~0o007)
        yield
    finally:
        os.umask(before)


def _busy(who: str, what: str) -> str:
    return f"another run ({who}) is writing {what}; wait for it to end"


def call_hooks(home: Path) -> tuple[dict[str, str | None], tuple[str, ...]]:
    """Call the functions of the entry point group `hdt.after_night` with the home, in the order of their names.

    Returns
    -------
    tuple
        What they give, by the name under which a command tells it, and a line for each that failed: the night is done
        and published, and the others follow.
    """
    given: dict[str, str | None] = {}
    failed = []
    for point in sorted(entry_points(group="hdt.after_night"), key=lambda p: p.name):
        try:
            given |= point.load()(home)
        except Exception as error:
            failed.append(f"{point.name}: {error}")
    return given, tuple(failed)


def tell_receivers(home: Path) -> tuple[str, ...]:
    """A line for each receiver of the night's digest that could not be told; a home without receivers costs nothing."""
    if not notify_file(home).exists():
        return ()
    from pipelines.digest import send_digests

    return tuple(send_digests(home))
