"""Small charts as inline SVG: a frame with axes, and lines, bands, dots and marks in it. Colours of Okabe and Ito."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta

from pipelines.report.html import Html, join, tag

BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#6b6b6b",
)  # fmt: skip
LEFT, RIGHT, TOP, BOTTOM = 42, 10, 16, 34
Number = float | int
Point = tuple[Number, Number]


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """Round numbers from `low` to `high`, about `wanted` of them; never outside, not even by what floats round."""
    span = max(high - low, 1e-12)
    power = 10.0 ** math.floor(math.log10(span / wanted))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if span / (m * power) <= wanted + 0.5)
    first = math.ceil(low / step - 1e-9)
    return [min(max(i * step, low), high) for i in range(first, math.floor(high / step + 1e-9) + 1)]


def month_ticks(low: float, high: float, wanted: int = 6) -> list[tuple[float, str]]:
    """Marks of a time axis in seconds since 1970, on first days of months, on round days where the span is short."""
    start, end = moment(low), moment(high)
    days = (end - start).days + 1
    if days <= 45:
        step = max(1, round(days / wanted))
        first = start.replace(hour=0, minute=0, second=0, microsecond=0) + timedelta(days=1)
        at = [first + timedelta(days=i) for i in range(0, days, step)]
        return [(t.timestamp(), f"{t:%d %b}") for t in at if t <= end]
    months = [datetime(y, m, 1, tzinfo=start.tzinfo) for y in range(start.year, end.year + 1) for m in range(1, 13)]
    inside = [t for t in months if start <= t <= end]
    every = next((n for n in (1, 2, 3, 6, 12) if len(inside) / n <= wanted), 24)
    kept = [t for t in inside if (t.year * 12 + t.month - 1) % every == 0]
    return [(t.timestamp(), f"{t:%b}" if t.month > 1 and every < 12 else f"{t:%Y}") for t in kept]


def moment(seconds: float) -> datetime:
    """Time in UTC."""
    return datetime.fromisoformat("1970-01-01T00:00:00+00:00") + timedelta(seconds=seconds)


def _n(value: float) -> str:
    """A coordinate, rounded to a tenth of a pixel."""
    return f"{value:.1f}".removesuffix(".0")


@dataclass
class Chart:
    """A frame in data coordinates; what is drawn is kept in order and cut at the frame."""

    x: tuple[float, float]
    y: tuple[float, float]
    label: str
    width: int = 400
    height: int = 230
    parts: list[Html] = field(default_factory=list)

    def at(self, x: Number, y: Number) -> tuple[float, float]:
        """Pixel of a point."""
        (x0, x1), (y0, y1) = self.x, self.y
        across = (x - x0) / ((x1 - x0) or 1.0)
        up = (y - y0) / ((y1 - y0) or 1.0)
        up, across = min(max(up, -0.02), 1.02), min(max(across, -0.02), 1.02)
        return LEFT + across * (self.width - LEFT - RIGHT), self.height - BOTTOM - up * (self.height - TOP - BOTTOM)

    def _path(self, points: Sequence[Point]) -> str:
        return "L".join(f"{_n(a)} {_n(b)}" for a, b in (self.at(*p) for p in points))

    def line(self, points: Sequence[Point], colour: str, *, dash: str | None = None, width: float = 1.6) -> None:
        """A line through points."""
        if len(points) > 1:
            self.parts.append(
                tag(
                    "path",
                    d=f"M{self._path(points)}",
                    fill="none",
                    stroke=colour,
                    stroke_width=width,
                    stroke_dasharray=dash,
                )
            )

    def band(self, points: Sequence[tuple[Number, Number, Number]], colour: str) -> None:
        """The area between low and high of (x, low, high)."""
        if len(points) > 1:
            edge = [(x, high) for x, _, high in points] + [(x, low) for x, low, _ in reversed(points)]
            self.parts.append(tag("path", d=f"M{self._path(edge)}Z", fill=colour, fill_opacity=0.22))

    def dots(self, points: Sequence[Point], colour: str, *, size: float = 2.4, opacity: float = 0.55) -> None:
        """A cloud of points, as one path."""
        at = "".join(f"M{_n(a)} {_n(b)}h0" for a, b in sorted({self.at(*p) for p in points}))
        if at:
            style = {"stroke": colour, "stroke_width": size, "stroke_linecap": "round", "stroke_opacity": opacity}
            self.parts.append(tag("path", d=at, fill="none", **style))

    def words(self, x: Number, y: Number, words: str, colour: str) -> None:
        """Words above a point, from it to the right."""
        a, b = self.at(x, y)
        self.parts.append(tag("text", words, x=_n(a), y=_n(b - 3), fill=colour))

    def mark(self, x: Number, shape: str, colour: str, says: str, letter: str = "") -> None:
        """An event: `work` stands on the bottom of the frame, `message` and `alert` hang from its top."""
        a, _ = self.at(x, self.y[0])
        top, bottom = TOP, self.height - BOTTOM
        rule = tag(
            "path", d=f"M{_n(a)} {top}V{bottom}", stroke=colour, stroke_width=1, stroke_dasharray="2 3", fill="none"
        )
        shapes = {
            "work": f"M{_n(a - 6)} {bottom}h12l-6 -11z",
            "message": f"M{_n(a - 4)} {top}l8 8m0 -8l-8 8",
            "alert": f"M{_n(a)} {top - 7}l5 6l-5 6l-5 -6z",
        }
        fill = {"message": "none"}.get(shape, colour)
        sign = tag("path", d=shapes[shape], fill=fill, stroke=colour, stroke_width=1.8)
        name = tag("text", letter, x=_n(a), y=bottom - 13, text_anchor="middle", fill=colour) if letter else None
        self.parts.append(tag("g", tag("title", says), rule, sign, name))

    def frame(self, x_marks: Sequence[tuple[float, str]], y_label: str, x_label: str = "") -> Html:
        """Grid, axes and labels: what lies under the drawing."""
        right, bottom = self.width - RIGHT, self.height - BOTTOM
        grid, names = [], []
        decimals = _decimals(ticks(*self.y))
        for v in ticks(*self.y):
            _, b = self.at(self.x[0], v)
            grid.append(f"M{LEFT} {_n(b)}H{right}")
            names.append(
                tag(
                    "text",
                    f"{v:.{decimals}f}".replace("-", "\N{MINUS SIGN}"),
                    x=LEFT - 4,
                    y=_n(b + 4),
                    text_anchor="end",
                )
            )
        for v, name in x_marks:
            a, _ = self.at(v, self.y[0])
            grid.append(f"M{_n(a)} {bottom}v4")
            names.append(tag("text", name, x=_n(a), y=bottom + 15, text_anchor="middle"))
        names.append(tag("text", y_label, x=2, y=10))
        if x_label:
            names.append(tag("text", x_label, x=right, y=self.height - 4, text_anchor="end"))
        box = tag("path", d=f"M{LEFT} {TOP}V{bottom}H{right}", class_="axis")
        return join(tag("path", d="".join(grid), class_="grid"), box, *names)

    def svg(self, x_marks: Sequence[tuple[float, str]], y_label: str, x_label: str = "") -> Html:
        """The chart, named for who can't see it."""
        inner = join(self.frame(x_marks, y_label, x_label), *self.parts)
        return tag("svg", tag("title", self.label), inner, viewBox=f"0 0 {self.width} {self.height}", role="img")


def _decimals(marks: Sequence[float]) -> int:
    step = abs(marks[1] - marks[0]) if len(marks) > 1 else 1.0
    quarters = round(step / 10.0 ** math.floor(math.log10(step)), 6) == 2.5
    return max(0, -math.floor(math.log10(step) + 1e-9)) + quarters


def number_ticks(low: float, high: float, show: Callable[[float], str] = "{:g}".format) -> list[tuple[float, str]]:
    """Marks of an axis of numbers."""
    return [(v, show(round(v, 10))) for v in ticks(low, high)]


def span(values: Sequence[float], pad: float = 0.05) -> tuple[float, float]:
    """Least and greatest of `values` with some room; 0 to 1 where there is none."""
    if not len(values):
        return 0.0, 1.0
    low, high = min(values), max(values)
    room = (high - low) * pad or abs(high) * pad or 1.0
    return low - room, high + room
