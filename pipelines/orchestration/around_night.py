"""Before a night, check its landing zone and lock its home; after it, call hooks of packages and send digests."""

import fcntl
import glob
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from importlib.metadata import entry_points
from pathlib import Path

from hdt_core.loading import UserError
from pipelines.storage.database import fleet_lock
from pipelines.storage.files import narrow_umask
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import notify_file


class BusyError(UserError):
    """Another run holds this home."""


def find_landing_fault(landing: Path) -> str | None:
    """Explain why a folder can't be a landing zone, and the remedy; None where it may be one.

    Without a fleet list it is an empty mount point or another folder, and a night over it would look like a day
    without flights.
    """
    if (landing / "fleet.csv").is_file():
        return None
    if not landing.is_dir():
        return (
            f"no landing zone at {landing}; give --landing the folder that holds fleet.csv and one folder per operator"
        )
    subfolder = next(iter(sorted(landing.glob("*/fleet.csv"))), None)
    if subfolder is not None:
        return f"{landing} is no landing zone, but {subfolder.parent} is; give --landing {subfolder.parent}"
    if not any(landing.iterdir()):
        return f"{landing} is empty; mount the landing zone there, or give --landing the folder that holds fleet.csv"
    return f"no fleet.csv in {landing}; give --landing the folder that holds it and one folder per operator"


def find_home_fault(home: Path) -> str | None:
    """Explain why a folder can't be a home, and the remedy; None where it may be one."""
    path = str(home.resolve())
    if glob.has_magic(path):  # DuckDB's read_parquet and Dagster's settings would take it for a pattern
        return f"a home's path has none of * ? [, and {path!r} has; give --home another folder"
    if re.search(r"\\|%[0-9A-Fa-f]{2}", path):  # deltalake would decode it, as of an address
        return f"a home's path has no backslash and no %XX, and {path!r} has; rename the folder"
    if not path.isprintable():
        return (
            f"a home's path has no control characters or bytes that are no UTF-8, and {path!r} has; rename the folder"
        )
    return None


@contextmanager
def lock_home(home: Path) -> Iterator[None]:
    """Lock `home` for one writer and, where the fleet's ledger is a database, the fleet.

    The operating system releases the lock when the process ends, however it ends.
    """
    home.mkdir(parents=True, exist_ok=True)
    with _restrict_permissions(home), open(home / ".lock", "a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            raise BusyError(_busy(f"process {lock.read().strip() or 'unknown'}", str(home))) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        url = Ledger(home).url
        with fleet_lock(url) if url else nullcontext() as other_writer:
            if other_writer:
                raise BusyError(_busy(other_writer, "this fleet"))
            yield


@contextmanager
def _restrict_permissions(home: Path) -> Iterator[None]:
    """Deny users outside the group access to the home and to files written within the block."""
    old_umask = narrow_umask()
    try:
        with suppress(PermissionError):  # a volume of another owner
            home.chmod(home.stat().st_mode & ~0o007)
        yield
    finally:
        os.umask(old_umask)


def _busy(writer: str, place: str) -> str:
    return f"another run ({writer}) is writing {place}; wait for it to end"


def call_hooks(home: Path) -> tuple[dict[str, str | None], tuple[str, ...]]:
    """Call the functions of the entry point group `hdt.after_night` with the home, in the order of their names.

    Returns
    -------
    tuple
        Results by the key under which a command prints them, and a line for each hook that failed: the night is
        published already, and the other hooks still run.
    """
    results: dict[str, str | None] = {}
    failed = []
    for point in sorted(entry_points(group="hdt.after_night"), key=lambda p: p.name):
        try:
            results |= point.load()(home)
        except Exception as error:
            failed.append(f"{point.name}: {error}")
    return results, tuple(failed)


@contextmanager
def report_failure(home: Path, report: Callable[[str], None]) -> Iterator[None]:
    """Send receivers the error that ends the block; `report` takes a line for each that was not reached."""
    try:
        yield
    except Exception as error:
        for line in notify_failure(home, [str(error) or type(error).__name__]):
            report(line)
        raise


def notify_failure(home: Path, reasons: Iterable[str]) -> list[str]:
    """Send receivers why a night failed; return a line for each that was not reached."""
    if not os.path.lexists(notify_file(home)):
        return []
    from pipelines.digest.delivery import send_failure

    causes = list(reasons)
    try:
        return send_failure(home, causes)
    except UserError as error:
        is_cause = str(error) in causes  # a wrong declaration of receivers, which is reported as why the night failed
        return [] if is_cause else [f"no message of the failed night was sent: {error}"]


def notify_receivers(home: Path) -> tuple[str, ...]:
    """Send the night's digests; return a line for each receiver that failed. A home without receivers costs nothing."""
    if not os.path.lexists(notify_file(home)):
        return ()
    from pipelines.digest.delivery import send_digests

    return tuple(send_digests(home))
