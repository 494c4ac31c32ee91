"""Bound Dagster's history after a night, to `dagster_history_days` of the home's `retention.toml` (90 by default)."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING

from sqlalchemy.exc import SQLAlchemyError

from dagster_batched.history import forget_runs
from pipelines.storage.ledger import Ledger
from pipelines.storage.retention import LONGEST_STEP_DAYS, has_jumped
from pipelines.storage.seal import CYCLE
from pipelines.storage.settings import retention

if TYPE_CHECKING:
    from pathlib import Path

    from dagster import DagsterInstance

LEAST_EVENTS = 10_000
"""Events that a night may delete or shorten whatever it made: half a second."""
EVENTS_OF_CELL = 8
"""Events for each cell the night made, twice as many as it wrote: a history that is too long becomes shorter."""


def forget_old_runs(home: Path, instance: DagsterInstance, cells: int) -> tuple[str, ...]:
    """Delete some of the runs older than the home keeps; a line where Dagster's storage refused.

    Nothing goes where the clock has jumped within the last `CYCLE` nights: by a wrong one every run is too old.

    Parameters
    ----------
    home : Path
        Folder of the home.
    instance : DagsterInstance
        Where the night's runs are recorded.
    cells : int
        Number of cells that the night made.
    """
    days = retention(home).dagster_history_days
    nights = [*Ledger(home).snapshots()]
    if has_jumped(nights[-CYCLE:], max(days, LONGEST_STEP_DAYS)):
        return ()
    before = datetime.now(UTC) - timedelta(days=days)
    try:
        forget_runs(instance, before, LEAST_EVENTS + EVENTS_OF_CELL * cells)
    except (OSError, SQLAlchemyError) as error:
        return (f"Dagster's history is not shortened: {str(error).splitlines()[0]}",)
    return ()
