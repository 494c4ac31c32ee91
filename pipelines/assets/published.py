"""Published assets: the catalog's views, each downstream of its sources, and the report."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dagster as dg

from pipelines.assets.stage import PUBLISHED, any_parent_newer, group_of
from pipelines.report.facts import views_read
from pipelines.resources import Home
from pipelines.storage.catalog import CATALOG
from pipelines.storage.headers import ViewHeader, read_header
from pipelines.storage.publication import order_views, publish, views

REPORT = "report.html"


def view_key(view: str) -> dg.AssetKey:
    """Return a view's asset key, prefixed, for some views are named like their table."""
    return dg.AssetKey(["catalog", view])


def _spec(view: str, header: ViewHeader) -> dg.AssetSpec:
    upstream = [
        dg.AssetKey(n.removeprefix("tables.")) if n.startswith("tables.") else view_key(n) for n in header.sources
    ]
    return dg.AssetSpec(
        view_key(view),
        deps=upstream,
        automation_condition=any_parent_newer(upstream),
        description=f"{header.question}\n\n{header.notes}",
        **group_of("published"),
        kinds={"duckdb", "view"},
        metadata={"grain": header.grain},
    )


VIEWS = [_spec(name, read_header(sql)) for name, sql in order_views(views())]


@dg.multi_asset(specs=VIEWS, name="catalog", description=f"Publishes {CATALOG}: all views over one night's tables.")
def catalog(home: Home) -> Iterator[dg.MaterializeResult[Any]]:
    """Publish all views at once, so that a reader sees one night. A night publishes by itself and reports it here."""
    publish(Path(home.home))
    yield from (dg.MaterializeResult(asset_key=spec.key) for spec in VIEWS)


_REPORT_VIEWS = [view_key(view) for view in views_read()]


@dg.asset(
    deps=_REPORT_VIEWS,
    automation_condition=any_parent_newer(_REPORT_VIEWS),
    group_name=PUBLISHED,
    owners=group_of("published")["owners"],
    kinds={"html"},
    description=f"The fleet's health as one page, `{REPORT}` in the home. What `hdt report` writes does not show here.",
)
def report(home: Home) -> dg.MaterializeResult[Any]:
    """Write the report from the present catalog."""
    from pipelines.report.page import write_report

    target = Path(home.home) / REPORT
    write_report(Path(home.home), target)
    return dg.MaterializeResult(metadata={"page": dg.MetadataValue.path(target), "bytes": target.stat().st_size})
