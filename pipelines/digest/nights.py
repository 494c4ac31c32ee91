"""Changes since a night that the ledger still knows."""

from pathlib import Path

from pipelines.digest.changes import Digest, compare
from pipelines.digest.state import EMPTY, read_state
from pipelines.storage.as_of import connect_as_of
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger


def changes_since(home: Path, night: str | None = None) -> Digest:
    """What changed since the last night at or before `night`; since the last but one, where none is named.

    Raises
    ------
    StoreError
        There was no night by then, or it is not kept any more.
    """
    with connect(home) as con:
        now = read_state(con)
    nights = sorted(Ledger(home, looks=True).snapshots())
    if night is None and len(nights) < 2:
        return compare(EMPTY, now)
    with connect_as_of(home, night or nights[-2]) as con:
        return compare(read_state(con), now)
