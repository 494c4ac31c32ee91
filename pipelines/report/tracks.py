"""Collect the data of each unit's chart (loss over time, events, forecast to the message) and lay it out as SVG.

Lines and areas are in a square that is stretched to any width, marks and ticks beside it.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Any

import polars as pl

from hdt_core.components import components
from hdt_core.robust import Z_90
from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.templating import anchor
from pipelines.report.words import visible
from pipelines.words import _

POINTS = 180
"""Flights in a chart."""
BANDS = 60
"""Time steps of the fleet's band."""
LEAST_PACKS = 4
"""Packs that a band needs at each step."""
DAY_MS = 86_400e3
EPOCH = date(1970, 1, 1)
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


def card_id(row: Row) -> str:
    """Return the id of the card of a pack, or of a unit of another component."""
    key = words.unit_key(row)
    return anchor("unit", row["component"], *key) if row["component"] else anchor("pack", *key)


def tracks(facts: Facts) -> dict[str, Row]:
    """Return the data of the chart of each pack and unit with a loss on record, by the id of its card."""
    charts: dict[str, Row] = {}
    packs: dict[tuple[Any, ...], list[str]] = {}
    for row in (unit.values for unit in facts.rows):
        key = words.unit_key(row)
        card = card_id(row)
        parts = {name: facts.of_pack(name, *key) for name in ("health", "alerts", "maintenance", "messages")}
        if row["component"]:
            losses = facts.of_pack("component_losses", *key).filter(component=row["component"])
            alerts = parts["alerts"].filter(component=row["component"])
            parts = {name: frame.clear() for name, frame in parts.items()} | {"health": losses, "alerts": alerts}
            compressor = losses.clear()
        else:
            health = parts["health"].rename({"value": "loss", "sd": "loss_sd"})
            losses, compressor = (health.filter(parameter=p) for p in ("hx_fouling", "cc_efficiency_loss"))
        if parts["health"].height:
            charts[card] = _track(losses, parts, row, _columns(thin(compressor)))
            if row["component"] is None:
                packs.setdefault(key[:2], []).append(card)
    for cards in packs.values():  # of two packs each names the other
        charts |= {a: charts[a] | {"other": b} for a, b in zip(cards, cards[1:] + cards[:1], strict=True) if a != b}
    return charts


def _columns(rows: pl.DataFrame) -> Columns:
    return {"x": rows.select(_ms("departed_at")).to_series().to_list(), "y": _percent(rows["loss"])}


def _track(losses: pl.DataFrame, parts: dict[str, pl.DataFrame], outlook: Row, cc: Columns) -> Row:
    """Return the data of a chart and its ranges. Times in ms since 1970, losses in percent."""
    flights = thin(losses)
    half_width = Z_90 * flights["loss_sd"].fill_null(0.0)
    low, high = (_percent(flights["loss"] + side * half_width) for side in (-1, 1))
    own = _columns(flights)
    whole = parts["health"].select(a=_ms("departed_at").min(), b=_ms("departed_at").max())
    start, now = whole.row(0)
    line = cc if outlook["outlook_component"] == "CC" else own
    fan = _fan(outlook, now, line["y"][-1]) if line["y"] else {}
    span = max(now - start, DAY_MS)
    ahead = min(max([0.22 * span, *(x - now for x, _y in fan.get("area", ()))]), 0.6 * span)
    top = max([45.0, *(v + 5.0 for v in own["y"]), *(y + 3.0 for _x, y in fan.get("area", ()))])
    return {
        "own": own | {"low": low, "high": high}, "cc": cc, "fan": fan, "now": now,
        "events": _events(parts, start), "x": (start, now + 1.03 * ahead), "y": (-10.0, top),
    }  # fmt: skip


def _fan(outlook: Row, now: int, loss: float) -> Row:
    """Return corners of the forecast's 90 % interval, its median where there is one, and the level of the message.

    Flights are converted to days at the aircraft's rate. The aircraft raises its message at a loss that differs between
    flights and units; the level is the usual one.
    """
    per_day = outlook["flights_per_day"]
    ends = [outlook[k] for k in ("rul_low", "rul_flights", "rul_high")]
    if per_day is None or None in ends:
        return {}
    low, median, high = (round(now + n * DAY_MS / per_day) for n in ends)
    level = max(100.0 * components()[outlook["outlook_component"]].limit.mean, loss)
    near = not outlook["is_bound"]
    return {
        "area": [(now, loss), (low, level), (high, level)], "level": level,
        "median": [(now, loss), (median, level)] if near else [],
    }  # fmt: skip


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


def _events(parts: dict[str, pl.DataFrame], start: int) -> list[Row]:
    """Return work, messages and alerts as marks with texts."""
    marks = [
        {"x": DAY_MS * (w["done_on"] - EPOCH).days, "kind": "work", "sign": f"{w['action'][:1]}▲", "text": _work(w)}
        for w in parts["maintenance"].to_dicts()
    ]
    marks += [
        {"x": 1e3 * m["message_time"].timestamp(), "kind": "message", "sign": "✕",
         "text": f"{words.clock(m['message_time'])}: {_message(m)}"}
        for m in parts["messages"].to_dicts()
    ]  # fmt: skip
    inside = [m for m in marks if m["x"] >= start - DAY_MS]
    return inside + [
        {"x": 1e3 * a["raised_at"].timestamp(), "kind": "alert", "sign": "◆", "text": _alert(a)}
        for a in parts["alerts"].to_dicts()
    ]


def _work(w: Row) -> str:
    part = _(str(words.PARTS.get(w["component"], w["component"])))
    action = w["action"].lower()
    translated = _(action)
    work = f"{words.day(w['done_on'])}: {part} {translated}"
    if not w["finding"]:
        return work
    finding = w["finding"].lower().replace("_", " ")
    translated = _(finding)
    return f"{work} ({translated})"


def _message(m: Row) -> str:
    return _("message {code}", code=m["code"]) + (f", {m['text']}" if m["text"] else "")


def _alert(a: Row) -> str:
    text = _("{day}: alert, {diagnosis}", day=words.day(a["raised_at"]), diagnosis=words.diagnosis(a["diagnosis"]))
    return text if a["closed_at"] is None else text + _(", closed")


SIDE = 1000
"""Width and height of a drawing, in its own units."""
TICKS, STEP = 4, 10
"""Dates on the axis, at most some; per cent between two lines of the grid."""
Points = Iterable[tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Frame:
    """Ranges of time [ms] and loss [%]."""

    x: tuple[float, float]
    y: tuple[float, float]

    def across(self, x: float) -> float:
        """Return the place of a time from the left."""
        return round(SIDE * (x - self.x[0]) / (self.x[1] - self.x[0]), 1)

    def down(self, y: float) -> float:
        """Return the place of a loss from above."""
        return round(SIDE * (self.y[1] - y) / (self.y[1] - self.y[0]), 1)

    def line(self, points: Points) -> str:
        """Format points for a line or the border of an area."""
        return " ".join(f"{self.across(x):g},{self.down(y):g}" for x, y in points)

    def area(self, band: Mapping[str, list[float]]) -> str:
        """Format the border between `low` and `high`."""
        low, high = (list(zip(band["x"], band[side], strict=True)) for side in ("low", "high"))
        return self.line([*high, *reversed(low)])


def drawing(tracks: Mapping[str, Row], name: str, fleet: Row, limit: float) -> Row:
    """Return areas, lines, levels, dots, marks and ticks of a chart.

    `tracks` are those of the function `tracks`, `fleet` the band of `fleet_band`, `limit` the loss that
    raises an alert.
    """
    track = tracks[name]
    frame = Frame(track["x"], track["y"])
    own = track["own"]
    fan = track["fan"]
    lines = {"other": tracks[track["other"]]["own"] if "other" in track else {}, "cc": track["cc"], "own": own}
    points = {k: list(zip(c.get("x", ()), c.get("y", ()), strict=True)) for k, c in lines.items()}
    points["median"] = fan.get("median", [])
    dots = points["median"][1:] + (points["own"] if len(points["own"]) == 1 else [])
    return {
        "areas": {"fleet": frame.area(fleet), "band": frame.area(own), "fan": frame.line(fan.get("area", ()))},
        "lines": {k: frame.line(p) for k, p in points.items()},
        "levels": {"limit": frame.down(100.0 * limit)} | ({"level": frame.down(fan["level"])} if fan else {}),
        "dots": [(frame.across(x), frame.down(y)) for x, y in dots],
        "marks": [m | {"x": frame.across(m["x"]), "text": visible(m["text"])} for m in track["events"]],
        "days": [(frame.across(x), text) for x, text in _days(*track["x"])],
        "percents": [(frame.down(y), y) for y in range(0, int(track["y"][1]) + 1, STEP)],
    }


def _days(start_ms: float, end_ms: float) -> list[tuple[float, str]]:
    """Return the first of every n-th month; some days where the record has no two such."""
    start, end = (datetime.fromtimestamp(ms / 1e3, UTC) for ms in (start_ms, end_ms))
    firsts = [datetime(y, m, 1, tzinfo=UTC) for y in range(start.year, end.year + 1) for m in range(1, 13)]
    months = [m for m in firsts if start <= m <= end]
    if len(months) > 1:
        return [(1e3 * m.timestamp(), f"{m:%Y-%m}") for m in months[:: -(-len(months) // TICKS)]]
    days = [start + k * (end - start) / TICKS for k in range(1, TICKS)]
    return [(1e3 * d.timestamp(), f"{d:%m-%d}") for d in days]
