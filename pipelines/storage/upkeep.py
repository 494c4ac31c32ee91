"""Remove files and versions beyond their retention after a night, once a day.

`retention.toml` of the home declares it: `keep_days` (30 by default) for what a night has replaced, and `hold`, nights
(dates, or times as `hdt query --as-of` takes them) that are never removed. Files are compacted as
they are written (`pipelines/storage/months.py`).
"""

import json
import time
from datetime import UTC, datetime, timedelta

from deltalake import DeltaTable

from hdt_core.tables import TABLES
from pipelines.storage.delta import QUIET
from pipelines.storage.files import LOG
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.settings import Retention, night_prefix, retention
from pipelines.storage.store import Store

MARKER = ".upkeep"
_EVERY_S = 20 * 3600
_COMMITS = 20  # between two checkpoints, from which a log is read on


def remove_expired_daily(store: Store, ledger: Ledger) -> None:
    """Remove what is beyond the home's own retention, unless that was done within the day; a new home holds nothing."""
    marker = store.home / MARKER
    if not marker.exists():
        marker.touch()
    elif time.time() - marker.stat().st_mtime >= _EVERY_S:
        remove_expired(store, ledger, retention(store.home))
        marker.touch()


def remove_expired(store: Store, ledger: Ledger, policy: Retention) -> None:
    """Delete nights beyond their retention, and the files that no night on record needs."""
    nights = ledger.snapshots()
    first = (datetime.now(UTC) - timedelta(days=policy.keep_days)).isoformat()
    protected_nights = {
        find_night(nights, night)[0] for night in policy.hold if any(n[: len(night)] <= night for n in nights)
    }
    ledger.delete_nights([name for name in nights if name < first and name not in protected_nights])
    for table in TABLES:
        versions = [nights[name][table] for name in protected_nights if name < first and table in nights[name]]
        if (log := store.tables.open(table)) is not None:
            _vacuum(store, table, log, policy.keep_days, versions)


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
    prefix = night_prefix(night)
    if prefix is None:
        raise StoreError(f"give a day (2024-06-19) or a time in UTC (2024-06-19T04:30), not {night}")
    earlier = [name for name in nights if name[: len(prefix)] <= prefix]
    if not earlier:
        first = f"the first on record is {min(nights)}" if nights else "none is on record"
        raise StoreError(f"no night at or before {night!r}; {first}")
    return max(earlier), nights[max(earlier)]
