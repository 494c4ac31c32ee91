"""One alert in a paragraph, from the catalog alone."""

from pathlib import Path
from typing import Any

from pipelines.catalog import connect

_ALERT = """
select alert_id, operator, tail, pack, component, diagnosis, raised_flight_id, raised_at, closed_at, severity,
    evidence, recommended_action
from alerts where starts_with(alert_id, $asked) or tail = $asked order by raised_at desc limit 1
"""
_SINCE = """
select hx_fouling, hx_fouling_sd, rul_flights, rul_low, rul_high, p_event_50
from fleet_ranking where operator = $operator and tail = $tail and pack = $pack
"""


def explain_alert(home: Path, asked: str) -> str | None:
    """The alert whose id begins with `asked`, or the latest of the tail `asked`; None where there is none."""
    with connect(home) as con:
        found = con.execute(_ALERT, {"asked": asked})
        row = found.fetchone()
        if row is None:
            return None
        alert = dict(zip((c[0] for c in found.description), row, strict=True))
        where = {name: alert[name] for name in ("operator", "tail", "pack")}
        now = con.execute(_SINCE, where).fetchone()
    return "\n".join([_head(alert), alert["evidence"], *_now(alert, now), f"Do: {alert['recommended_action']}"])


def _head(alert: dict[str, Any]) -> str:
    ended = f"closed {alert['closed_at']:%Y-%m-%d %H:%M}" if alert["closed_at"] else "open"
    return (
        f"{alert['operator']} {alert['tail']} pack {alert['pack']}: {alert['diagnosis']} ({alert['severity']}),"
        f" raised {alert['raised_at']:%Y-%m-%d %H:%M} UTC after {alert['raised_flight_id']}, {ended}."
        f" Alert {alert['alert_id']}."
    )


def _now(alert: dict[str, Any], now: tuple[Any, ...] | None) -> list[str]:
    """How the exchanger of that pack is after its last flight, where the alert is about it."""
    if now is None or now[0] is None or alert["component"] != "HX":
        return []
    fouling, sd, rul, low, high, event = now
    said = f"After its last flight the pack has lost {fouling:.0%} of its conductance (sd {sd or 0:.1%})."
    if rul is not None and low is not None:
        said += f" About {rul:.0f} flights are left (90 %: {low:.0f} to {high:.0f})"
        said += f"; a message within 50 flights has a probability of {event:.0%}." if event is not None else "."
    return [said]
