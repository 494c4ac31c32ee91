"""Checks of what is about to be stored."""

from typing import Any

import dagster as dg


class CheckBeforeStorage(dg.AssetCheckResult):
    """A check's result that belongs to the output it comes before.

    Dagster would look up, table by table, what was stored before.
    """

    def _get_target_materialization_data(self, *_: Any) -> None:
        return None
