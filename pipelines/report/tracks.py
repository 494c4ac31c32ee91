"""How each pack has worn, what was done to it, and what is expected: one chart a pack."""

from datetime import UTC, datetime
from typing import Any

import polars as pl

from pipelines.report import svg, words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, anchor, join, tag

POINTS = 180  # a chart is some 350 pixels wide
Z_90 = 1.645
DAY_S = 86_400.0


def tracks(facts: Facts) -> Html:
    """A section with a chart for every pack, the most urgent first."""
    rows = facts["ranking"].to_dicts()
    if not rows:
        return tag("p", "No flight has given a health estimate yet.", class_="empty")
    return join(_LEGEND, tag("div", *(_card(facts, row) for row in rows), class_="cards"))


def _key(colour: str, sign: str, says: str) -> Html:
    return tag("span", tag("b", sign, style=f"color:{colour}"), " ", says)


_LEGEND = tag(
    "p",
    _key(svg.BLUE, "━", "heat exchanger: conductance lost, with its 90 % band"),
    _key(svg.ORANGE, "╍", "compressor: efficiency lost"),
    _key(svg.PURPLE, "◆", "alert"),
    _key(svg.VERMILLION, "✕", "message from the aircraft"),
    _key(svg.GREEN, "▲", "work (R replaced, C cleaned, I inspected, A adjusted)"),
    _key(svg.VERMILLION, "├●┤", "message expected: median and 90 % interval"),
    class_="legend",
)


def _card(facts: Facts, row: dict[str, Any]) -> Html:
    key = row["operator"], row["tail"], row["pack"]
    parts = {name: facts.of_pack(name, *key) for name in ("health", "alerts", "maintenance", "messages")}
    urgency = words.URGENCY[row["urgency"]]
    head = tag("h3", words.pack_name(row), " ", tag("span", urgency, class_=f"tag {row['urgency']}"))
    left = words.flights_left(row)
    chance = words.chance(row["p_event_50"])
    state = f"UA lost {words.loss(row)}; flights left {left}; chance of a message within 50 flights {chance}."
    return tag(
        "article",
        head,
        tag("p", state),
        _chart(facts, row, parts),
        _recent(parts),
        id=anchor("pack", *key),
        class_="card",
        data_find=words.found_by(row, row["diagnoses"]),
    )


def seconds(column: pl.Series) -> list[float]:
    """Moments as seconds from 1970."""
    return (column.dt.epoch("ms") / 1000.0).to_list()


def thin(rows: pl.DataFrame) -> pl.DataFrame:
    """The last flight of each of `POINTS` stretches: values as they were said, and no more than can be seen."""
    if rows.height <= POINTS:
        return rows
    return (
        rows.with_columns(g=(pl.int_range(pl.len()) * POINTS) // pl.len())
        .group_by("g", maintain_order=True)
        .last()
        .drop("g")
    )


def _chart(facts: Facts, row: dict[str, Any], parts: dict[str, pl.DataFrame]) -> Html | None:
    hx = parts["health"].filter(parameter="hx_fouling")
    if not parts["health"].height:
        return tag("p", "No estimate yet: no flight with steady cruise.", class_="empty")
    when = seconds(parts["health"]["departed_at"])
    start, now = min(when), max(when)
    ahead = max(0.22 * (now - start), 5 * DAY_S)
    top = max([45.0, *(100 * hx["value"] + 5).to_list()])
    chart = svg.Chart((start, now + ahead), (-10.0, top), f"Health of {words.pack_name(row)} over time")
    _lines(chart, hx, parts["health"].filter(parameter="cc_efficiency_loss"))
    _events(chart, parts, start)
    # at which loss the message comes differs from flight to flight, so it has no line: only its time is drawn
    _expected(chart, facts, row, now, 100 * hx["value"][-1] if hx.height else 0.0)
    return chart.svg(svg.month_ticks(start, now + ahead, 5), "% lost")


def _lines(chart: svg.Chart, hx: pl.DataFrame, cc: pl.DataFrame) -> None:
    worn = thin(hx)
    when = seconds(worn["departed_at"])
    low = (100 * (worn["value"] - Z_90 * worn["sd"].fill_null(0.0))).to_list()
    high = (100 * (worn["value"] + Z_90 * worn["sd"].fill_null(0.0))).to_list()
    chart.band(list(zip(when, low, high, strict=True)), svg.BLUE)
    worn_cc = thin(cc)
    chart.line(
        list(zip(seconds(worn_cc["departed_at"]), (100 * worn_cc["value"]).to_list(), strict=True)),
        svg.ORANGE,
        dash="5 2",
    )
    chart.line(list(zip(when, (100 * worn["value"]).to_list(), strict=True)), svg.BLUE)
    if len(when) == 1:
        chart.dots([(when[0], 100 * worn["value"][0])], svg.BLUE, size=6, opacity=1)


def _midnight(day: Any) -> float:
    return datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()


def _events(chart: svg.Chart, parts: dict[str, pl.DataFrame], start: float) -> None:
    for w in parts["maintenance"].to_dicts():
        if (at := _midnight(w["done_on"])) >= start - DAY_S:
            chart.mark(at, "work", svg.GREEN, _work(w), w["action"][:1])
    for m in parts["messages"].to_dicts():
        if (at := m["message_time"].timestamp()) >= start:
            chart.mark(at, "message", svg.VERMILLION, f"{words.clock(m['message_time'])}: {_message(m)}")
    for a in parts["alerts"].to_dicts():
        chart.mark(a["raised_at"].timestamp(), "alert", svg.PURPLE, _alert(a))


def _work(w: dict[str, Any]) -> str:
    finding = f" ({w['finding'].lower().replace('_', ' ')})" if w["finding"] else ""
    return (
        f"{words.day(w['done_on'])}: {words.PARTS.get(w['component'], w['component'])} {w['action'].lower()}{finding}"
    )


def _message(m: dict[str, Any]) -> str:
    return f"message {m['code']}" + (f", {m['text']}" if m["text"] else "")


def _alert(a: dict[str, Any]) -> str:
    return f"{words.day(a['raised_at'])}: alert, {words.diagnosis(a['diagnosis'])}"


def _expected(chart: svg.Chart, facts: Facts, row: dict[str, Any], now: float, height: float) -> None:
    """When the message is expected, flights turned into days at the pace of the last thirty."""
    low, mid, high, p = row["rul_low"], row["rul_flights"], row["rul_high"], row["p_event_50"]
    if None in (low, mid, high, p) or p < 0.05:
        return
    own = facts["flights"].filter(operator=row["operator"], tail=row["tail"]).tail(31)
    pace_s = max((own["departed_at"][-1] - own["departed_at"][0]).total_seconds() / max(own.height - 1, 1), 3600.0)
    chart.line([(now + low * pace_s, height), (now + high * pace_s, height)], svg.VERMILLION, width=3)
    chart.dots([(now + mid * pace_s, height)], svg.VERMILLION, size=8, opacity=1)


def _recent(parts: dict[str, pl.DataFrame]) -> Html | None:
    """The last events in words, for who can't hover and for print."""
    events = [(words.day(w["done_on"]), _work(w)) for w in parts["maintenance"].to_dicts()]
    events += [
        (words.day(a["raised_at"]), _alert(a) + ("" if a["closed_at"] is None else ", closed"))
        for a in parts["alerts"].to_dicts()
    ]
    events += [
        (words.day(m["message_time"]), f"{words.day(m['message_time'])}: {_message(m)}")
        for m in parts["messages"].to_dicts()
    ]
    last = sorted(set(events), reverse=True)[:3]
    return tag("p", "Last events: ", "; ".join(says for _, says in last), ".", class_="small") if last else None
