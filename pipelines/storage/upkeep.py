"""What a store does by itself after a night, once a day: files and versions that nobody may want any more go.

`retention.toml` of the home declares it: `keep_days` (30 by default) for what a night has replaced, and `hold`, nights
(dates, or times as `hdt query --as-of` takes them) that stay for as long as they stand there. Files are compacted as
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
from pipelines.storage.settings import Retention, retention
from pipelines.storage.store import Store

DONE = ".upkeep"
_EVERY_S = 20 * 3600
_COMMITS = 20  # between two checkpoints, from which a log is read on


def keep_house(store: Store, ledger: Ledger, declared: Retention | None = None) -> None:
    """Forget nights beyond their time, and remove files that no night on record needs.

    At most once a day, and as the home declares, unless it is `declared` here.
    """
    done = store.home / DONE
    if declared is None and not done.exists():  # a new home holds nothing old
        done.touch()
    if declared is None and time.time() - done.stat().st_mtime < _EVERY_S:
        return
    declared, nights = declared or retention(store.home), ledger.snapshots()
    first = (datetime.now(UTC) - timedelta(days=declared.keep_days)).isoformat()
    held = {night_by(nights, night)[0] for night in declared.hold if any(n[: len(night)] <= night for n in nights)}
    ledger.forget_nights([name for name in nights if name < first and name not in held])
    for table in TABLES:
        kept = [nights[name][table] for name in held if name < first and table in nights[name]]
        if (log := store.tables.open(table)) is not None:
            _tidy(store, table, log, declared.keep_days, kept)
    done.touch()


def _tidy(store: Store, table: str, log: DeltaTable, keep_days: int, held: list[int]) -> None:
    """Vacuum a table, and let its log begin later unless an old night is held."""
    hours = 24 * keep_days
    if log.vacuum(hours, enforce_retention_duration=False, full=True, keep_versions=held or None):
        log.vacuum(hours, False, False, full=True, keep_versions=held or None, post_commithook_properties=QUIET)
        log.update_incremental()
    if log.version() - _checkpoint(store, table) >= _COMMITS:
        log.create_checkpoint()
        if not held:
            log.cleanup_metadata()
    store.place.settle(table, log.version())


def _checkpoint(store: Store, table: str) -> int:
    try:
        return int(json.loads(store.place.get(f"{table}/{LOG}/_last_checkpoint"))["version"])
    except (OSError, ValueError, KeyError):
        return 0


def night_by(nights: dict[str, dict[str, int]], night: str) -> tuple[str, dict[str, int]]:
    """The last night at or before the one that is asked for, and its versions of the tables."""
    before = [name for name in nights if name[: len(night)] <= night]
    if not before:
        first = f"the first on record is {min(nights)}" if nights else "none is on record"
        raise StoreError(f"no night at or before {night!r}; {first}")
    return max(before), nights[max(before)]
