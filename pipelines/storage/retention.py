"""Remove what is beyond its retention: old nights, and the files that no night on record needs.

`retention.toml` of the home declares `keep_days` (30 by default) for what a night has replaced, and `hold`, nights
(dates, or times as `hdt query --as-of` takes them) that are never removed.
"""

import json
import time
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from itertools import pairwise

from deltalake import DeltaTable

from hdt_core.tables import TABLES
from pipelines.storage.delta import QUIET
from pipelines.storage.files import LOG
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.seal import CYCLE
from pipelines.storage.settings import Retention, night_prefix, retention
from pipelines.storage.store import Store

MARKER = ".upkeep"
_EVERY_S = 20 * 3600
LONGEST_STEP_DAYS = 30  # from one night to the next; more is a clock that jumped, or a home long at rest
_COMMITS = 20  # between two checkpoints, from which a log is read on


def remove_expired_daily(store: Store, ledger: Ledger) -> None:
    """Remove what is beyond the home's own retention, unless that was done within the day; a new home holds nothing."""
    marker = store.home / MARKER
    if not marker.exists():
        marker.touch()
    elif abs(time.time() - marker.stat().st_mtime) >= _EVERY_S:  # a clock may have been ahead
        remove_expired(store, ledger, retention(store.home))
        marker.touch()


def remove_expired(store: Store, ledger: Ledger, policy: Retention) -> None:
    """Delete nights beyond their retention but the last, and the files that no night on record needs.

    Nothing goes where the clock has jumped within the last `CYCLE` nights: by a wrong one every night is too old.
    """
    nights = ledger.snapshots()
    if has_jumped([*nights][-CYCLE:], max(policy.keep_days, LONGEST_STEP_DAYS)):
        return
    first = (datetime.now(UTC) - timedelta(days=policy.keep_days)).isoformat()
    protected_nights = {
        find_night(nights, night)[0] for night in policy.hold if any(n[: len(night)] <= night for n in nights)
    }
    replaced = [*nights][:-1]
    ledger.delete_nights([name for name in replaced if name < first and name not in protected_nights])
    for table in TABLES:
        versions = [nights[name][table] for name in protected_nights if name < first and table in nights[name]]
        if (log := store.tables.open(table)) is not None:
            _vacuum(store, table, log, policy.keep_days, versions)


def has_jumped(nights: Iterable[str], longest_days: float) -> bool:
    """Return whether the clock went back, or on by more than so many days, from one night to the next or to now."""
    times = [datetime.fromisoformat(night.partition("#")[0]) for night in nights]
    steps = pairwise([*times, datetime.now(UTC)])
    return any(not timedelta() <= after - before <= timedelta(days=longest_days) for before, after in steps)


def _vacuum(store: Store, table: str, log: DeltaTable, keep_days: int, protected_versions: list[int]) -> None:
    """Vacuum a table, and shorten its log unless an old night is protected."""
    hours = 24 * keep_days
    if log.vacuum(hours, enforce_retention_duration=False, full=True, keep_versions=protected_versions or None):
        log.vacuum(
            hours, False, False, full=True, keep_versions=protected_versions or None, post_commithook_properties=QUIET
        )
        log.update_incremental()
    if log.version() - _checkpoint(store, table) >= _COMMITS:
        log.create_checkpoint()
        if not protected_versions:
            log.cleanup_metadata()
    store.place.sync_commit(table, log.version())


def _checkpoint(store: Store, table: str) -> int:
    try:
        return int(json.loads(store.place.get(f"{table}/{LOG}/_last_checkpoint"))["version"])
    except (OSError, ValueError, KeyError):
        return 0


def find_night(nights: dict[str, dict[str, int]], night: str) -> tuple[str, dict[str, int]]:
    """Find the last night at or before a date or time, or the first part of one, and its versions of the tables."""
    if night in nights:
        return night, nights[night]
    prefix = night_prefix(night.partition("#")[0])
    if prefix is None:
        raise StoreError(f"give a day (2024-06-19) or a time in UTC (2024-06-19T04:30), not {night}")
    earlier = [name for name in nights if name[: len(prefix)] <= prefix]
    if not earlier:
        first = f"the first on record is {min(nights).partition('#')[0]}" if nights else "none is on record"
        raise StoreError(f"no night at or before {night!r}; {first}")
    return earlier[-1], nights[earlier[-1]]
