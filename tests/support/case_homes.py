"""A home whose catalog was made by hand: what cases need, without a night."""

from pathlib import Path

import polars as pl
from alert_texts import evidence_of, text_columns
from nights import empty_home
from small_catalog import OWN, alert, flight, fouling

from hdt_core.components import component_rows
from hdt_core.tables import TABLES
from pipelines.storage.publication import publish
from pipelines.storage.store import FLEET, Store


def case_home(home: Path) -> Path:
    """A pack of AAA with two open alerts, `wear` and `clog`, and a closed one, `gone`; one of BBB with `other`."""
    flights = [flight(n) for n in range(60)]
    theirs = {"operator": "BBB", "tail": "T-9"}
    alerts = [_alert("wear", 30), _alert("clog", 50), _alert("gone", 5, 20), _alert("other", 59) | theirs]
    flown = [*flights, flight(59, tail="T-9", operator="BBB")]
    empty_home(home)
    return publish_losses(home, 0.2, raw_flights=flown, features_alerts=alerts, components=component_rows())


def publish_losses(home: Path, loss: float, **tables: list[dict]) -> Path:
    """A night after which the pack of AAA has lost so much; further tables are stored as well."""
    theirs = fouling(59, 0.01, tail="T-9") | {"operator": "BBB"}
    health = [*(fouling(n, 0.01) for n in range(59)), fouling(59, loss), theirs]
    store = Store(home)
    for name, rows in (tables | {"twin_health": health}).items():
        frame = TABLES[name].schema.conform(pl.DataFrame(rows, infer_schema_length=None))
        aircraft = [FLEET] if TABLES[name].grain == "fleet" else frame.select("operator", "tail").unique().rows()
        store.replace(name, aircraft, frame)
    publish(home)
    return home


def _alert(name: str, raised: int, closed: int | None = None) -> dict:
    now = flight(59 if closed is None else closed)["flight_id"]
    last = {"now_flight_id": now, "raised_severity": "medium"}
    texts = text_columns(evidence_of("e"), evidence_of("e"), "<b>wash</b>")
    return OWN | alert(name, raised, closed) | last | texts
