"""A small simulated fleet with known truth, in SI, as the legs stage receives it."""

from typing import NamedTuple

import polars as pl
import pytest

from hdt_core.simulate.design import FleetSettings
from hdt_core.simulate.fleet import Aircraft, simulate_fleet
from pipelines.intake.columns import SIGNAL_COLUMNS


class Fleet(NamedTuple):
    snapshots: pl.DataFrame
    maintenance: pl.DataFrame
    messages: pl.DataFrame
    truth: pl.DataFrame


def _si(aircraft: Aircraft, rows: pl.DataFrame, source: str) -> pl.DataFrame:
    columns = rows.columns
    signals = [
        (pl.col(c.name).cast(pl.Float64) * c.scale + c.offset if c.name in columns else pl.lit(None, pl.Float64)).alias(
            c.si_name
        )
        for c in SIGNAL_COLUMNS
    ]
    phase = pl.col("phase_code") if "phase_code" in columns else pl.lit(None, pl.String)
    return rows.select(
        pl.lit(aircraft.operator).alias("operator"),
        pl.lit(aircraft.tail).alias("tail"),
        "flight_id",
        pl.col("pack").cast(pl.Int32),
        pl.col("report_time").cast(pl.Datetime("us", "UTC")).alias("time_utc"),
        pl.lit(source).alias("source"),
        phase.alias("phase_code"),
        *signals,
    )


def _logged(aircraft: Aircraft, rows: pl.DataFrame) -> pl.DataFrame:
    place = (pl.lit(aircraft.operator).alias("operator"), pl.lit(aircraft.tail).alias("tail"))
    return rows.with_columns(*place, pl.col("pack").cast(pl.Int32))


def make_fleet(seed: int, settings: FleetSettings) -> Fleet:
    fleet = list(simulate_fleet(seed, settings))
    logs = [_si(a, log, "cpl") for a in fleet for log in a.cpl.values()]
    snapshots = [_si(a, a.snapshots, "acms") for a in fleet] + logs
    return Fleet(
        pl.concat(snapshots),
        pl.concat(_logged(a, a.maintenance) for a in fleet),
        pl.concat(_logged(a, a.messages) for a in fleet),
        pl.concat(a.health for a in fleet).with_columns(pl.col("pack").cast(pl.Int32)),
    )


@pytest.fixture(scope="session")
def fleet() -> Fleet:
    return make_fleet(13, FleetSettings(operators=1, tails=3, flights=220, cpl_share=0.02))
