"""Hold flights whose time or identity can't be right."""

import polars as pl

from pipelines.assets.stage import stage
from pipelines.record import judge_record
from pipelines.resources import Home


@stage
def record(home: Home) -> pl.DataFrame:
    """Judge each flight against its neighbours, its aircraft and the fleet."""
    return judge_record(home.ledger)
