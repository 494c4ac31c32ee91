"""The Dagster location: `dagster dev`, the daemon and `hdt` all run the assets built here."""

import os
from pathlib import Path
from typing import Any

import dagster as dg

from dagster_batched.instance import batch_events
from pipelines.assets import asset_definitions
from pipelines.assets.stage import SENSORS
from pipelines.orchestration.jobs import every_night, landing_zone, nightly
from pipelines.storage.files import narrow_umask


def build_defs(*, landing: str | Path, home: str | Path, **overrides: Any) -> dg.Definitions:
    """Build the whole location over one landing zone and one home; `overrides` replace resources by name."""
    sensors = [landing_zone, *SENSORS]
    return asset_definitions(landing, home, overrides, jobs=[nightly], schedules=[every_night], sensors=sensors)


def from_environment() -> dg.Definitions:
    """Build the definitions for `dagster dev`: folders from HDT_LANDING and HDT_HOME, else those of `make run`."""
    batch_events()
    narrow_umask()
    return build_defs(
        landing=Path(os.environ.get("HDT_LANDING", "data_samples")).resolve(),
        home=Path(os.environ.get("HDT_HOME", "hdt_home")).resolve(),
    )


defs = from_environment()
