"""The command `hdt metrics`: figures of the last night as Prometheus text."""

import json
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from pipelines.cli.base import HomeDir, StopError, app, home_folder, out

OutFile = Annotated[Path | None, typer.Option("--out", help="File for node_exporter's textfile collector, `*.prom`.")]
_NIGHT = {
    "files": "files in the landing zone",
    "new_files": "of these, files that were new or had changed",
    "runs": "runs of Dagster",
    "cells": "cells computed: a table of a flight, an aircraft or the fleet",
}
_BY_LABEL = {
    "last_flight_timestamp_seconds": (
        "departure of the last flight on record",
        ("operator",),
        "select operator, epoch(max(departed_at)) from flights group by operator",
    ),
    "quarantined_rows": (
        "rows set aside, all nights",
        ("operator", "reason"),
        "select coalesce(operator, ''), reason, sum(n_rows)::double from quarantine where n_rows > 0 group by all",
    ),
    "refused_files": (
        "files of which nothing is stored, all nights",
        ("operator", "file", "reason"),
        """
        select distinct coalesce(operator, ''), file, reason, 1.0 from quarantine where scope = 'file'
        or file in (select file from deliveries where delivered > 0 and loaded + duplicate = 0) and scope <> 'note'
        """,
    ),
    "noted_files": (
        "files taken in with a note, all nights",
        ("operator", "reason"),
        "select coalesce(operator, ''), reason, count(distinct file)::double from quarantine where scope = 'note'"
        " group by all",
    ),
    "open_alerts": (
        "open alerts",
        ("operator", "urgency"),
        "select operator, urgency, count(*)::double from open_alerts group by all",
    ),
}
"""Meaning, labels and query of each figure by label; the value is the query's last column."""


@app.command()
def metrics(home: HomeDir = None, out_file: OutFile = None) -> None:
    """Write figures of the last night for Prometheus."""
    library = _library()
    registry = read_metrics(home_folder(home))
    if out_file is None:
        out.print(library.generate_latest(registry).decode(), markup=False, soft_wrap=True, end="")
        return
    library.write_to_textfile(str(out_file), registry)
    out.print(f"Metrics: {out_file}", soft_wrap=True)


def read_metrics(home: Path) -> Any:
    """Read the figures of a home into a `CollectorRegistry`.

    Raises
    ------
    StopError
        There was no night yet, or the library is missing.
    """
    from pipelines.storage.catalog import connect
    from pipelines.storage.ledger import Ledger

    nights = Ledger(home, read_only=True).nights()
    if nights.is_empty():
        raise StopError(f"no night has ended in {home}; run `hdt nightly` first")
    library = _library()
    night = nights.row(-1, named=True)
    registry = library.CollectorRegistry()
    gauge = partial(library.Gauge, registry=registry)
    began, ended = (datetime.fromisoformat(night[c]).astimezone(UTC).timestamp() for c in ("began_at", "ended_at"))
    for name, meaning in _NIGHT.items():
        gauge(f"hdt_night_{name}", f"Last night: {meaning}").set(float(night[name]))
    gauge("hdt_night_seconds", "Last night: duration").set(ended - began)
    gauge("hdt_night_ended_timestamp_seconds", "Last night: its end").set(ended)
    gauge("hdt_night_failed", "Last night: runs that failed").set(len(json.loads(night["failed"])))
    with connect(home) as con:
        for name, (meaning, labels, query) in _BY_LABEL.items():
            figure = gauge(f"hdt_{name}", meaning.capitalize(), labels)
            for *values, value in con.execute(query).fetchall():
                figure.labels(*values).set(value)
    return registry


def _library() -> Any:
    try:
        import prometheus_client
    except ImportError:
        raise StopError("it needs the extra: pip install 'hybrid-digital-twin-extensions[metrics]'") from None
    return prometheus_client
