"""Collect the data of each unit's chart: loss over time, events and forecast."""

from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import polars as pl

from hdt_core.robust import Z_90
from pipelines.report import words
from pipelines.report.charts import GREEN, PURPLE, VERMILLION
from pipelines.report.facts import Facts
from pipelines.report.templating import anchor
from pipelines.words import _

POINTS = 180
"""Flights in a chart, which is some 350 pixels wide."""
BANDS = 60
"""Time steps of the fleet's band."""
LEAST_PACKS = 4
"""Packs that a band needs at each step."""
DAY_S = 86_400.0
Row = dict[str, Any]
Columns = dict[str, list[Any]]


def fleet_band(facts: Facts) -> Columns:
    """Return the fleet's loss over time: 5 and 95 % points over packs of each pack's median in a time step."""
    losses = facts["health"].filter(parameter="hx_fouling")
    pack = ["operator", "tail", "pack"]
    if losses.select(pack).n_unique() < LEAST_PACKS:
        return {"x": [], "low": [], "high": []}
    at = _ms("departed_at")
    first, last = losses.select(at.min().alias("a"), at.max().alias("b")).row(0)
    step = max(last - first, 1) / BANDS
    stretch = ((pl.col("at") - first) // step).cast(pl.Int64).alias("stretch")
    of_pack = losses.with_columns(at=at).group_by(stretch, *pack).agg(pl.col("value").median())
    points = [(100 * pl.col("value").quantile(q, "linear")).alias(n) for q, n in ((0.05, "low"), (0.95, "high"))]
    band = of_pack.group_by("stretch").agg(*points, n=pl.len()).filter(pl.col("n") >= LEAST_PACKS).sort("stretch")
    middle = [round(first + (k + 0.5) * step) for k in band["stretch"]]
    return {"x": middle, **{n: [round(v, 1) for v in band[n]] for n in ("low", "high")}}


def pack_tracks(facts: Facts) -> dict[str, Row]:
    """Return the data of each pack's chart by the id of its card."""
    tracks = {}
    for row in facts["ranking"].to_dicts():
        key = words.unit_key(row)
        parts = {name: facts.of_pack(name, *key) for name in ("health", "alerts", "maintenance", "messages")}
        if not parts["health"].height:
            continue
        hx = parts["health"].filter(parameter="hx_fouling").rename({"value": "loss", "sd": "loss_sd"})
        own = _track(hx, parts, row, _pace_ms(facts, row))
        cc = thin(parts["health"].filter(parameter="cc_efficiency_loss"))
        own["cc"] = {"x": cc.select(_ms("departed_at")).to_series().to_list(), "y": _percent(cc["value"])}
        tracks[anchor("pack", *key)] = own | {"tail": f"{row['operator']} {row['tail']}"}
    for tail in {t["tail"] for t in tracks.values()}:  # each of two packs names the other
        for a, b in pairwise([*(names := [k for k, t in tracks.items() if t["tail"] == tail]), names[0]]):
            if a != b:
                tracks[a]["other"] = b
    return tracks


def unit_tracks(facts: Facts) -> dict[str, Row]:
    """Return the data of the chart of each unit of another component."""
    tracks = {}
    for row in facts["components"].to_dicts():
        own = facts.of_pack("component_losses", *words.unit_key(row)).filter(component=row["component"])
        alerts = facts.of_pack("alerts", *words.unit_key(row)).filter(component=row["component"])
        if own.height:
            none = {name: facts[name].clear() for name in ("maintenance", "messages")}
            tracks[anchor("unit", row["component"], *words.unit_key(row))] = _track(own, {"alerts": alerts} | none)
    return tracks


def _track(
    losses: pl.DataFrame, parts: dict[str, pl.DataFrame], row: Row | None = None, pace_ms: float | None = None
) -> Row:
    """Return the columns of the chart's sources, and its ranges. Times in ms since 1970, losses in percent."""
    flights = thin(losses)
    at = flights.select(_ms("departed_at")).to_series().to_list()
    half_width = Z_90 * flights["loss_sd"].fill_null(0.0)
    low, high = (_percent(flights["loss"] + side * half_width) for side in (-1, 1))
    whole = parts.get("health", flights).select(a=_ms("departed_at").min(), b=_ms("departed_at").max())
    start, now = whole.row(0)
    own = {"x": at, "y": _percent(flights["loss"]), "low": low, "high": high}
    y = (-10.0, max([45.0, *(v + 5.0 for v in own["y"])]))
    ahead = _ahead(row, pace_ms, now, own["y"][-1] if own["y"] else 0.0) if row and pace_ms else {}
    span = now - start
    until = min(max([0.22 * span, *(v - now for v in ahead.get("high", ()))]), 0.5 * span)
    x = (start, now + (max(1.03 * until, 5e3 * DAY_S) if row else 6e4))
    return {"own": own, "ahead": ahead, "events": _events(parts, start, y), "x": x, "y": y}


def thin(rows: pl.DataFrame) -> pl.DataFrame:
    """Keep the last flight of each of `POINTS` groups of successive flights."""
    if rows.height <= POINTS:
        return rows
    return (
        rows.with_columns(g=(pl.int_range(pl.len()) * POINTS) // pl.len())
        .group_by("g", maintain_order=True)
        .last()
        .drop("g")
    )


def _ms(moment: str) -> pl.Expr:
    return pl.col(moment).dt.epoch("ms")


def _percent(shares: pl.Series) -> list[float]:
    return (100 * shares).round(1).to_list()


def _events(parts: dict[str, pl.DataFrame], start: int, y: tuple[float, float]) -> Columns:
    """Return work, messages and alerts as marks with texts."""
    marks: list[tuple[Any, ...]] = [
        (1e3 * _midnight(w["done_on"]), "triangle", GREEN, w["action"][:1], _work(w))
        for w in parts["maintenance"].to_dicts()
    ]
    marks += [
        (1e3 * m["message_time"].timestamp(), "x", VERMILLION, "", f"{words.clock(m['message_time'])}: {_message(m)}")
        for m in parts["messages"].to_dicts()
    ]
    inside = [e for e in marks if e[0] >= start - 1e3 * DAY_S]
    inside += [(1e3 * a["raised_at"].timestamp(), "diamond", PURPLE, "", _alert(a)) for a in parts["alerts"].to_dicts()]
    bottom, top = y[0] + 0.04 * (y[1] - y[0]), y[1] - 0.04 * (y[1] - y[0])
    return {
        "x": [round(e[0]) for e in inside],
        "y": [bottom if e[1] == "triangle" else top for e in inside],
        "bottom": [y[0]] * len(inside),
        "top": [y[1]] * len(inside),
        **{name: [e[k] for e in inside] for k, name in enumerate(("marker", "colour", "letter"), start=1)},
        "text": [words.visible(e[4]) for e in inside],
    }


def _midnight(day: Any) -> float:
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()


def _work(w: Row) -> str:
    finding = f" ({_(w['finding'].lower().replace('_', ' '))})" if w["finding"] else ""
    part = _(str(words.PARTS.get(w["component"], w["component"])))
    return f"{words.day(w['done_on'])}: {part} {_(w['action'].lower())}{finding}"


def _message(m: Row) -> str:
    return _("message {code}", code=m["code"]) + (f", {m['text']}" if m["text"] else "")


def _alert(a: Row) -> str:
    return _("{day}: alert, {diagnosis}", day=words.day(a["raised_at"]), diagnosis=words.diagnosis(a["diagnosis"]))


def _pace_ms(facts: Facts, row: Row) -> float | None:
    """Return the mean time between flights [ms]; None where the record is too short."""
    (per_day,) = facts["rates"].filter(operator=row["operator"], tail=row["tail"])["flights_per_day"]
    return None if per_day is None else 1e3 * DAY_S / per_day


def _ahead(row: Row, pace_ms: float, now: int, loss: float) -> Columns:
    """Return the time of the expected message, with flights converted to days.

    The loss at which it is raised differs between flights, so only its time is drawn.
    """
    points = {name: row[of] for name, of in (("low", "rul_low"), ("mid", "rul_flights"), ("high", "rul_high"))}
    p = row["p_event_50"]
    if None in points.values() or p is None or p < 0.05:
        return {}
    return {name: [round(now + n * pace_ms)] for name, n in points.items()} | {"y": [loss]}


def recent(facts: Facts, row: Row) -> list[str]:
    """Return the last three events as text, for touch screens and print."""
    parts = {name: facts.of_pack(name, *words.unit_key(row)) for name in ("alerts", "maintenance", "messages")}
    events = [(words.day(w["done_on"]), _work(w)) for w in parts["maintenance"].to_dicts()]
    events += [
        (words.day(a["raised_at"]), _alert(a) + ("" if a["closed_at"] is None else _(", closed")))
        for a in parts["alerts"].to_dicts()
    ]
    events += [
        (words.day(m["message_time"]), f"{words.day(m['message_time'])}: {_message(m)}")
        for m in parts["messages"].to_dicts()
    ]
    return [text for _day, text in sorted(set(events), reverse=True)[:3]]
