"""The command `hdt metrics`: figures of the last night as Prometheus text."""

import json
from datetime import UTC, datetime
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
        "select operator, epoch(max(departed_at)) from flights group by operator",
    ),
    "quarantined_rows": (
        "rows set aside, all nights",
        "select coalesce(operator, ''), reason, sum(n_rows)::double from quarantine where n_rows > 0 group by all",
    ),
    "open_alerts": ("open alerts", "select operator, urgency, count(*)::double from open_alerts group by all"),
}
"""Meaning and query of each figure with labels; the value is the last column."""
_LABELS = {"quarantined_rows": ("operator", "reason"), "open_alerts": ("operator", "urgency")}


@app.command()
def metrics(home: HomeDir = None, out_file: OutFile = None) -> None:
    """Write figures of the last night for Prometheus."""
    registry = read_metrics(home_folder(home))
    from prometheus_client import generate_latest, write_to_textfile

    if out_file is None:
        out.print(generate_latest(registry).decode(), markup=False, soft_wrap=True, end="")
        return
    write_to_textfile(str(out_file), registry)
    out.print(f"Metrics: {out_file}", soft_wrap=True)


def read_metrics(home: Path) -> Any:
    """Read the figures of a home into a `CollectorRegistry`.

    Raises
    ------
    StopError
        There was no night yet, or the library is missing.
    """
    try:
        from prometheus_client import CollectorRegistry, Gauge
    except ImportError:
        raise StopError("it needs the extra: pip install 'hybrid-digital-twin-extensions[metrics]'") from None
    from pipelines.storage.catalog import connect
    from pipelines.storage.ledger import Ledger

    nights = Ledger(home, read_only=True).nights()
    if nights.is_empty():
        raise StopError(f"no night has ended in {home}; run `hdt nightly` first")
    registry, night = CollectorRegistry(), nights.row(-1, named=True)
    began, ended = (datetime.fromisoformat(night[c]).astimezone(UTC).timestamp() for c in ("began_at", "ended_at"))
    for name, meaning in _NIGHT.items():
        Gauge(f"hdt_night_{name}", f"Last night: {meaning}", registry=registry).set(float(night[name]))
    Gauge("hdt_night_seconds", "Last night: duration", registry=registry).set(ended - began)
    Gauge("hdt_night_ended_timestamp_seconds", "Last night: its end", registry=registry).set(ended)
    failures = Gauge("hdt_night_failed", "Last night: runs that failed", registry=registry)
    failures.set(len(json.loads(night["failed"])))
    with connect(home) as con:
        for name, (meaning, query) in _BY_LABEL.items():
            gauge = Gauge(f"hdt_{name}", meaning.capitalize(), _LABELS.get(name, ("operator",)), registry=registry)
            for *labels, value in con.execute(query).fetchall():
                gauge.labels(*labels).set(value)
    return registry
