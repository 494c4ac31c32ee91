"""Named places where a test or a benchmark makes the process die or the disk full.

The storage tells of each as an audit event (`sys.audit("hdt.before_rename")`), which nobody hears in production. After
`arm("before_rename:3")` the process is killed (SIGKILL) when it comes to `before_rename` for the third time;
`before_mark:1:full` raises "no space left on device" there, `any:5:term` sends SIGTERM at the fifth place of any name.
The fingerprint of a home tells whether its tables are those of a night that nothing disturbed.
"""

import errno
import hashlib
import os
import signal
import sys
from collections.abc import Callable
from itertools import count
from pathlib import Path

import polars as pl

from hdt_core.alerts.succession import KINDS_OF_NIGHT
from hdt_core.tables import TABLES
from pipelines.storage.store import Store

POINTS = (
    "before_write", "before_rename", "after_rename", "before_commit", "after_commit", "before_register",
    "after_register", "before_mark", "after_mark", "before_publish",
)  # fmt: skip
"""In `files.replacing`, which writes every file, in a table's commit, in two writers of the ledger, and at the end."""
OF_OBJECTS = ("before_write", "before_commit", "after_commit")
"""Where a shard becomes an object and a commit names it, in an object store."""
_ENDS = {"kill": signal.SIGKILL, "term": signal.SIGTERM}


def arm(plan: str, cut: Callable[[], None] | None = None) -> None:
    """Arm one fault in this process; `cut` runs before a kill. The audit hook lasts as long as the process."""
    target, nth, action = (*plan.split(":"), "kill")[:3]
    events = {f"hdt.{point}" for point in POINTS if target in (point, "any")}
    passed = count(1)

    def strike(event: str, _: object) -> None:
        if event not in events or next(passed) != int(nth):
            return
        if action == "full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), event)
        if cut:
            cut()
        os.kill(os.getpid(), _ENDS[action])

    sys.addaudithook(strike)


def fingerprint(home: Path, *url: str) -> dict[str, str]:
    """Hash of every table's rows, sorted; of the home's store, or of that at `url`.

    Of a fitted model its `model_version`, which is a hash of what it knows: the archive holds the hour it was packed,
    card and service what was in service before. Of the log of cases what people wrote: a night's own lines are of what
    moved on the way.
    """
    store = Store(home, *url)
    return {table: _hash(_lasting(table, store.read_table(table))) for table in TABLES}


def _lasting(table: str, rows: pl.DataFrame) -> pl.DataFrame:
    """Return what does not depend on the nights between."""
    if table == "raw_cases":
        return rows.filter(~pl.col("kind").is_in(KINDS_OF_NIGHT))
    return rows.drop("card", "service", strict=False)


def _hash(frame: pl.DataFrame) -> str:
    frame = frame.with_columns(pl.col(pl.List(pl.Float64)).cast(pl.List(pl.String)).list.join(","))
    plain = pl.concat_str((~pl.selectors.binary()).cast(pl.String).fill_null("\0"), separator="\x1f")
    return hashlib.blake2b("\n".join(frame.select(plain).to_series().sort()).encode(), digest_size=16).hexdigest()
