"""What readers meet after a night: the catalog's views, each behind what it reads, and the report."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dagster as dg

from pipelines.assets.automation import PUBLISHED, newer_than_made
from pipelines.assets.stage import owners
from pipelines.report.facts import views_read
from pipelines.resources import Home
from pipelines.storage.catalog import CATALOG
from pipelines.storage.headers import ViewHeader, read_header
from pipelines.storage.publication import order_views, publish, views

REPORT = "report.html"


def view_key(view: str) -> dg.AssetKey:
    """Key of a view; some are named like the table behind them."""
    return dg.AssetKey(["catalog", view])


def _spec(view: str, header: ViewHeader) -> dg.AssetSpec:
    read = [dg.AssetKey(n.removeprefix("tables.")) if n.startswith("tables.") else view_key(n) for n in header.sources]
    return dg.AssetSpec(
        view_key(view),
        deps=read,
        automation_condition=newer_than_made(read),
        description=f"{header.question}\n\n{header.notes}",
        group_name=PUBLISHED,
        owners=owners(PUBLISHED),
        kinds={"duckdb", "view"},
        metadata={"grain": header.grain},
    )


VIEWS = [_spec(name, read_header(sql)) for name, sql in order_views(views())]


@dg.multi_asset(specs=VIEWS, name="catalog", description=f"Publishes {CATALOG}: all views over one night's tables.")
def catalog(home: Home) -> Iterator[dg.MaterializeResult[Any]]:
    """Made whole: a reader meets the views of one night. A night publishes by itself and says so here."""
    publish(Path(home.home))
    yield from (dg.MaterializeResult(asset_key=spec.key) for spec in VIEWS)


_SHOWN = [view_key(view) for view in views_read()]


@dg.asset(
    deps=_SHOWN,
    automation_condition=newer_than_made(_SHOWN),
    group_name=PUBLISHED,
    owners=owners(PUBLISHED),
    kinds={"html"},
    description=f"The fleet's health as one page, `{REPORT}` in the home. What `hdt report` writes does not show here.",
)
def report(home: Home) -> dg.MaterializeResult[Any]:
    """The page over the catalog as it stands."""
    from pipelines.report.page import write_report

    target = Path(home.home) / REPORT
    write_report(Path(home.home), target)
    return dg.MaterializeResult(metadata={"page": dg.MetadataValue.path(target), "bytes": target.stat().st_size})
