"""Stages of the chain as Dagster assets, each one call into `hdt_core`; the location of all of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import dagster as dg

from pipelines.resources import Home, frame_io


def asset_definitions(
    landing: str | Path, home: str | Path, overrides: Mapping[str, Any] | None = None, **parts: Any
) -> dg.Definitions:
    """Build all assets with their resources; `overrides` replace resources by name, `parts` are jobs and the like."""
    resources = {
        "home": Home(landing=str(landing), home=str(home)),
        "io_manager": frame_io.configured({"home": str(home)}),
        **(overrides or {}),
    }
    stages = dg.load_assets_from_package_name(__name__)
    return dg.Definitions(assets=stages, resources=resources, executor=dg.in_process_executor, **parts)
