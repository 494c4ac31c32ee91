"""Lay out a unit's chart as SVG: lines and areas in a square that is stretched to any width, marks and ticks beside."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from pipelines.report.words import visible

SIDE = 1000
"""Width and height of a drawing, in its own units."""
TICKS, STEP = 4, 10
"""Dates on the axis, at most some; per cent between two lines of the grid."""
Row = dict[str, Any]
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

    `tracks` are those of `tracks.tracks`, `fleet` the band of `fleet_band`, `limit` the loss that
    raises an alert.
    """
    track = tracks[name]
    frame, own, fan = Frame(track["x"], track["y"]), track["own"], track["fan"]
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
