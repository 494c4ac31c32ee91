"""The Dagster location: `dagster dev`, the daemon and `hdt` all run the assets built here."""

import os
from pathlib import Path
from typing import Any

import dagster as dg

from pipelines.assets import calibration, features, legs, prognosis, raw, residuals, twin
from pipelines.eventlog import batch_events
from pipelines.resources import Home, frame_io
from pipelines.schedules import every_night, landing_zone, nightly

STAGES = (raw, legs, calibration, twin, residuals, features, prognosis)


def build_defs(*, landing: str | Path, home: str | Path, **overrides: Any) -> dg.Definitions:
    """The whole location over one landing zone and one home; `overrides` replace resources by name."""
    assets = dg.load_assets_from_modules(STAGES)
    resources = {
        "home": Home(landing=str(landing), home=str(home)),
        "io_manager": frame_io.configured({"home": str(home)}),
        **overrides,
    }
    return dg.Definitions(
        assets=assets,
        resources=resources,
        jobs=[nightly],
        schedules=[every_night],
        sensors=[landing_zone],
        executor=dg.in_process_executor,
    )


def from_environment() -> dg.Definitions:
    """Definitions for `dagster dev`: folders from HDT_LANDING and HDT_HOME, else those of `make run`."""
    batch_events()
    return build_defs(
        landing=Path(os.environ.get("HDT_LANDING", "data_samples")).resolve(),
        home=Path(os.environ.get("HDT_HOME", "hdt_home")).resolve(),
    )


defs = from_environment()
