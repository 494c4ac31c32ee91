"""Stages of the chain as Dagster assets, each one call into `hdt_core`; the catalog's views and the report."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import dagster as dg

from pipelines.assets.stage import any_parent_newer, group_of
from pipelines.report.facts import views_read
from pipelines.resources import Home, frame_io
from pipelines.storage.catalog import CATALOG
from pipelines.storage.publication import publish
from pipelines.storage.view_headers import view_headers


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


REPORT = "report.html"


def view_key(view: str) -> dg.AssetKey:
    """Return a view's asset key, prefixed, for some views are named like their table."""
    return dg.AssetKey(["catalog", view])


def _source_key(source: str) -> dg.AssetKey:
    return dg.AssetKey(source.removeprefix("tables.")) if source.startswith("tables.") else view_key(source)


_GROUP = group_of("published")
_HEADERS = view_headers()
_UPSTREAM = {view: [_source_key(source) for source in header.sources] for view, header in _HEADERS.items()}
VIEWS = [
    dg.AssetSpec(
        view_key(view),
        deps=_UPSTREAM[view],
        automation_condition=any_parent_newer(_UPSTREAM[view]),
        description=f"{header.question}\n\n{header.notes}",
        **_GROUP,
        kinds={"duckdb", "view"},
        metadata={"grain": header.grain},
    )
    for view, header in _HEADERS.items()
]


@dg.multi_asset(specs=VIEWS, name="catalog", description=f"Publishes {CATALOG}: all views over one night's tables.")
def catalog(home: Home) -> Iterator[dg.MaterializeResult[Any]]:
    """Publish all views at once, so that a reader sees one night. A night publishes by itself and reports it here."""
    publish(Path(home.home))
    yield from (dg.MaterializeResult(asset_key=spec.key) for spec in VIEWS)


def write_home_report(home: Path) -> Path:
    """Write the report into the home, and return its path."""
    from pipelines.report.page import write_report

    target = home / REPORT
    write_report(home, target)
    return target


_REPORT_VIEWS = [view_key(view) for view in views_read()]


@dg.asset(
    deps=_REPORT_VIEWS,
    automation_condition=any_parent_newer(_REPORT_VIEWS),
    group_name=_GROUP["group_name"],
    owners=_GROUP["owners"],
    kinds={"html"},
    description=f"The fleet's health as one page, `{REPORT}` in the home. What `hdt report` writes does not show here.",
)
def report(home: Home) -> dg.MaterializeResult[Any]:
    """Write the report from the present catalog."""
    target = write_home_report(Path(home.home))
    return dg.MaterializeResult(metadata={"page": dg.MetadataValue.path(target), "bytes": target.stat().st_size})
