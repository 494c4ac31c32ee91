"""What must hold of every home after every night, whatever was delivered."""

import re
from importlib import resources
from pathlib import Path
from typing import Any

import polars as pl

from benchmarks.fault_points import fingerprint
from pipelines.storage.catalog import connect
from pipelines.storage.store import Store

KEYS = {
    "flights": "operator tail flight_id departed_at landed_at source n_snapshots cruise_minutes",
    "legs": "operator tail flight_id pack admitted n_samples n_nominal",
    "design_parameters": "scope component parameter identifiable dsm_version",
    "health_parameters": "operator tail flight_id pack departed_at component parameter status",
    "residuals": "operator tail flight_id pack component signal kind",
    "features": "operator tail flight_id pack departed_at",
    "prognoses": "operator tail flight_id pack component departed_at model_version split",
    "alerts": "alert_id operator tail pack component diagnosis raised_flight_id raised_at severity",
    "quarantine": "file reason received_at",
}
"""Views of the contract and their columns that are never NULL."""


def faults(home: Path, landing: Path) -> list[str]:
    """Everything that is wrong with a home, in words; empty when nothing is."""
    problems = []
    with connect(home) as con:
        for view, columns in KEYS.items():
            frame = con.sql(f"select * from {view}").pl()
            problems += [f"{view}.{c} is NULL" for c in columns.split() if frame[c].null_count()]
        for check in (resources.files("sql") / "checks").iterdir():
            if check.name.endswith(".sql") and (rows := con.execute(check.read_text()).fetchall()):
                problems.append(f"{check.name}: {len(rows)} rows, first {rows[0]}")
        files = con.execute("select file from deliveries union select file from quarantine").fetchall()
        loaded = con.execute("select coalesce(sum(loaded), 0) from deliveries").fetchone()[0]
    stored = sum(Store(home).read_table(t).height for t in ("raw_snapshots", "raw_logs", *_LOGS))
    lines = Store(home).read_table("raw_components").select("file", "flight_id", "pack", "component", "time_utc")
    stored += lines.unique().height
    problems += [f"{loaded} rows loaded, {stored} stored"] if loaded != stored else []
    return problems + [f"nothing is told of {f}" for f in sorted(_delivered(landing) - {f for (f,) in files})]


_LOGS = ("raw_messages", "raw_maintenance", "raw_fleet", "raw_checks")


def _delivered(landing: Path) -> set[str]:
    names = {str(f.relative_to(landing)) for f in landing.rglob("*") if f.is_file()}
    return {n for n in names if not re.search(r"(^|/)\.|\.part(ial)?(/|$)", n)}


def answers(home: Path) -> dict[str, int]:
    """What each promised view answers, as a sum over its rows."""
    sums = {}
    with connect(home) as con:
        for view in KEYS:
            frame = con.sql(f"from {view}").pl().select(pl.exclude("received_at").cast(pl.String, strict=False))
            sums[view] = frame.hash_rows().sum()
    return sums


def state(home: Path) -> dict[str, Any]:
    """Hash of every table as it is stored, and what the catalog answers."""
    return fingerprint(home) | {f"view {view}": answer for view, answer in answers(home).items()}
