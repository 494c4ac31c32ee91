"""Named places where a test makes the process die or the disk full; nothing happens while HDT_FAULT is unset.

`HDT_FAULT=before_rename:3` kills the process (SIGKILL) when it comes to `before_rename` for the third time;
`before_mark:1:full` raises "no space left on device" there, `any:5:term` sends SIGTERM at the fifth place of any name.
"""

import errno
import os
import signal
from collections import Counter

POINTS = (
    "before_write",
    "before_rename",
    "after_rename",
    "before_commit",
    "after_commit",
    "before_register",
    "after_register",
    "before_mark",
    "after_mark",
)
"""In `files.replacing`, which writes every file, in a table's commit, and in the two writers of the ledger."""
OF_OBJECTS = ("before_write", "before_commit", "after_commit")
"""Where a shard becomes an object and a commit names it, in an object store."""

_passed: Counter[str] = Counter()


def fault_point(name: str) -> None:
    """Pass a named place, or not."""
    plan = os.environ.get("HDT_FAULT")
    if plan is None:
        return
    wanted, count, action = (*plan.split(":"), "kill")[:3]
    if wanted not in (name, "any"):
        return
    _passed[plan] += 1
    if _passed[plan] == int(count):
        _strike(action, name)


def _strike(action: str, name: str) -> None:
    if action == "full":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), name)
    os.kill(os.getpid(), signal.SIGTERM if action == "term" else signal.SIGKILL)
