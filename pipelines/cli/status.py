"""Where a home stands: cells by state, the last good night, the catalog's age, the quarantine."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.lineage import LINEAGE
from pipelines.storage.catalog import CATALOG, connect
from pipelines.storage.ledger import Ledger
from pipelines.versions import expected, undone


def status_of(home: Path) -> dict[str, Any]:
    """What `hdt status` says, as plain values.

    A cell waits when it was never made or when what it was made of has changed; what depends on a waiting cell is
    counted when that one has been made.
    """
    ledger = Ledger(home, looks=True)
    assets = {}
    for table in LINEAGE:
        cells, waiting = expected(ledger, table).height, undone(ledger, [table]).height
        assets[table] = {"cells": cells, "up_to_date": cells - waiting, "waiting": waiting}
    nights = ledger.nights().rows(named=True)
    good = [n for n in nights if n["failed"] == "{}"]
    written = datetime.fromtimestamp((home / CATALOG).stat().st_mtime, UTC)
    return {
        "assets": assets,
        "last_run": nights[-1]["ended_at"] if nights else None,
        "last_run_failed": nights[-1]["failed"] if nights and nights[-1]["failed"] != "{}" else None,
        "last_good_run": good[-1]["ended_at"] if good else None,
        "catalog_age_hours": round((datetime.now(UTC) - written).total_seconds() / 3600, 2),
        "quarantined": _quarantined(home),
    }


def _quarantined(home: Path) -> int:
    with connect(home) as con:
        found = con.execute("select count(*) from quarantine").fetchone()
    return int(found[0]) if found else 0
