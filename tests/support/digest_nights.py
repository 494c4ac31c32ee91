"""Two nights of one aircraft, as a digest tells them apart."""

import datetime as dt
from pathlib import Path
from typing import NamedTuple

import polars as pl
from alert_texts import evidence_of, text_columns
from nights import empty_home

from hdt_core.components import component_rows
from hdt_core.tables import TABLES
from pipelines.storage.publication import publish
from pipelines.storage.store import FLEET, Store

START = dt.datetime(2024, 3, 1, 6, tzinfo=dt.UTC)


def flight(n: int, tail: str = "T-1") -> dict:
    at = START + dt.timedelta(days=n // 2, hours=4 * (n % 2))
    return {"operator": "AAA", "tail": tail, "flight_id": f"{tail}_{at:%Y%m%d}_{n % 2 + 1:02d}", "departed_at": at,
            "landed_at": at + dt.timedelta(hours=2), "source": "acms"}  # fmt: skip


def alert(name: str, severity: str, last: int, *, closed: int | None = None) -> dict:
    raised = flight(10)
    now = flight(last)
    ends = None if closed is None else flight(closed)["departed_at"]
    return raised | {
        "alert_id": name, "pack": 1, "component": "HX", "diagnosis": "HX_SUDDEN_CLOG", "severity": severity,
        "raised_severity": "low", **text_columns(evidence_of("then"), evidence_of("now"), "=wash & look <now>"),
        "raised_flight_id": raised["flight_id"], "raised_at": raised["departed_at"], "closed_at": ends,
        "now_flight_id": now["flight_id"],
    }  # fmt: skip


class Night(NamedTuple):
    """What a night makes of one aircraft: its last flight, alerts, and the outlook after that flight."""

    last: int
    alerts: list[dict]
    outlook: tuple[float, float, float]


def publish_night(home: Path, night: Night) -> None:
    """Store it as a night would, and publish."""
    store = Store(home) if home.exists() else empty_home(home)
    own = [("AAA", "T-1")]
    low, middle, high = night.outlook
    fields = {"pack": 1, "component": "HX", "model_version": "m", "split": "live", "p_event_50": 0.2}
    fields |= {"rul_low": low, "rul_flights": middle, "rul_high": high}
    outlook = [flight(n) | fields for n in range(night.last + 1)]
    life = {"life": 0, "first_row": 0, "end_row": night.last + 1, "n_flights": night.last + 1, "censored": True}
    life |= {"operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "age_known": False}
    loss = {"pack": 1, "component": "HX", "parameter": "hx_fouling", "value": 0.2, "sd": 0.01, "unit": "-"}
    health = [flight(n) | loss | {"status": "ok", "estimator": "ekf"} for n in range(night.last + 1)]
    store.replace("twin_health", own, TABLES["twin_health"].schema.conform(pl.DataFrame(health)))
    store.replace("raw_flights", own, pl.DataFrame([flight(n) for n in range(night.last + 1)]))
    store.replace("features_alerts", own, pl.DataFrame(night.alerts, infer_schema_length=None))
    store.replace("prognoses", [FLEET], pl.DataFrame(outlook))
    store.replace("prognosis_lives", [FLEET], pl.DataFrame([life]))
    store.replace("components", [FLEET], pl.DataFrame(component_rows()))
    publish(home)


FIRST = Night(40, [alert("aaaa", "low", 40), alert("bbbb", "medium", 40)], (40.0, 80.0, 120.0))
SECOND = Night(42, [alert("aaaa", "high", 42), alert("bbbb", "medium", 42, closed=42), alert("cccc", "low", 42)],
               (5.0, 10.0, 30.0))  # fmt: skip
