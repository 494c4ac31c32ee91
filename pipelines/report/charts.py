"""Charts that zoom: Bokeh figures made once, whose sources the page fills when a chart comes into view."""

import json
import re
from collections.abc import Sequence
from typing import Any

from bokeh.embed import json_item
from bokeh.models import (
    BasicTicker,
    BasicTickFormatter,
    ColumnDataSource,
    DatetimeTicker,
    DatetimeTickFormatter,
    HoverTool,
    Range1d,
)
from bokeh.plotting import figure
from bokeh.resources import Resources

from pipelines.words import _

BLUE, ORANGE, GREEN, VERMILLION, PURPLE, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#B0578D", "#56B4E9", "#6b6b6b",
)  # fmt: skip
"""Colours of Okabe and Ito; the page takes lighter ones for a dark ground."""
INK, LINE = "#1a1a1a", "#d5d5d5"
Numbers = Sequence[float]
Chart = dict[str, Any]


def chart_script() -> str:
    """What draws the charts in the browser."""
    return "".join(Resources(mode="inline", components=["bokeh"]).js_raw)


def packed(drawn: Any) -> dict[str, Any]:
    """A figure as the page keeps it: the same bytes wherever and whenever it was made."""
    item = json_item(drawn)
    text = json.dumps({"doc": item["doc"], "root_id": item["root_id"]}, ensure_ascii=False)
    known: dict[str, str] = {}
    same = re.sub(r'"p(\d+)"', lambda m: known.setdefault(m[0], f'"c{len(known)}"'), text)
    loaded: dict[str, Any] = json.loads(same)
    return loaded


def source(name: str, *columns: str) -> ColumnDataSource:
    """A source that the page fills."""
    return ColumnDataSource({c: [] for c in columns}, name=name)


def axes(x_label: str = "", *, time: bool = False, height: int = 230) -> Any:
    """An empty figure in the page's style; only along x can one zoom, so that what stands at an edge stays there."""
    drawn = figure(
        height=height, sizing_mode="stretch_width", tools="xpan,xwheel_zoom,xbox_zoom,reset", active_drag="xbox_zoom",
        x_range=Range1d(name="x", bounds="auto"), y_range=Range1d(name="y"), toolbar_location="above",
        output_backend="svg", x_axis_type="datetime" if time else "linear", min_border=0,
        background_fill_alpha=0.0, border_fill_alpha=0.0, outline_line_color=None,
    )  # fmt: skip
    drawn.toolbar.logo = None
    drawn.toolbar.autohide = True
    drawn.xaxis.axis_label = x_label or None
    for axis in drawn.axis:
        axis.axis_line_color = axis.major_tick_line_color = axis.major_label_text_color = INK
        axis.axis_label_text_color = INK
        axis.minor_tick_line_color = None
        axis.axis_label_text_font_style = "normal"
        axis.major_label_text_font_size = axis.axis_label_text_font_size = "11px"
    drawn.xgrid.grid_line_color = None
    drawn.ygrid.grid_line_color = LINE
    drawn.yaxis.ticker = BasicTicker(desired_num_ticks=5)
    drawn.yaxis.formatter = BasicTickFormatter(use_scientific=False)
    if time:
        drawn.xaxis.ticker = DatetimeTicker(desired_num_ticks=4)
        drawn.xaxis.formatter = DatetimeTickFormatter(
            hours="%m-%d %H:%M", days="%m-%d", months="%Y-%m", years="%Y", context=None
        )
    return drawn


def track() -> dict[str, Any]:
    """How a unit has worn over time: fleet's band, the other pack, its own loss, what happened, what is expected."""
    drawn = axes(time=True)
    fleet, own = source("fleet", "x", "low", "high"), source("own", "x", "y", "low", "high")
    other, cc = source("other", "x", "y"), source("cc", "x", "y")
    drawn.varea("x", "low", "high", source=fleet, fill_color=GREY, fill_alpha=0.16)
    drawn.varea("x", "low", "high", source=own, fill_color=BLUE, fill_alpha=0.25)
    drawn.line("x", "y", source=other, line_color=GREY, line_width=1.2, line_dash="dotted")
    drawn.line("x", "y", source=cc, line_color=ORANGE, line_width=1.5, line_dash="dashed")
    line = drawn.line("x", "y", source=own, line_color=BLUE, line_width=1.8)
    drawn.scatter("x", "y", source=source("alone", "x", "y"), color=BLUE, size=6)
    _events(drawn)
    ahead = source("ahead", "low", "mid", "high", "y")
    drawn.segment("low", "y", "high", "y", source=ahead, line_color=VERMILLION, line_width=3)
    drawn.scatter("mid", "y", source=ahead, color=VERMILLION, size=8)
    said = [(_("day"), "@x{%F}"), (_("lost"), "@y{0.0} %"), (_("90 %"), _("@low{0.0} to @high{0.0} %"))]
    drawn.add_tools(
        HoverTool(renderers=[line], tooltips=said, formatters={"@x": "datetime"}, mode="vline", line_policy="nearest")
    )
    return packed(drawn)


def _events(drawn: Any) -> None:
    """Alerts and messages hang from the top of the frame, work stands on its bottom."""
    events = source("events", "x", "y", "top", "bottom", "marker", "colour", "letter", "text")
    drawn.segment("x", "bottom", "x", "top", source=events, line_color="colour", line_dash="dotted", line_width=1)
    signs = drawn.scatter("x", "y", source=events, marker="marker", color="colour", size=10)
    letters = {"text_font_size": "11px", "text_align": "center", "y_offset": -8}
    drawn.text("x", "y", "letter", source=events, text_color="colour", **letters)
    drawn.add_tools(HoverTool(renderers=[signs], tooltips=[("", "@text")]))


def cloud(x: Numbers, y: Numbers, x_label: str, line: tuple[Numbers, Numbers] | None = None) -> Chart:
    """Dots, with a line through them where there is one."""
    drawn = axes(x_label)
    drawn.scatter(list(x), list(y), color=BLUE, alpha=0.55, size=4)
    if line is not None:
        drawn.line(*map(list, line), line_color=VERMILLION, line_width=1.8)
    return framed(drawn, x, y)


def over_cruise(minutes: Numbers, sensor: Numbers, twin: Numbers, model: Numbers) -> Chart:
    """A sensor against twin and model."""
    drawn = axes(height=200)
    drawn.line(list(minutes), list(model), line_color=ORANGE, line_dash="dashed", line_width=1.6)
    drawn.line(list(minutes), list(twin), line_color=BLUE, line_width=1.6)
    drawn.scatter(list(minutes), list(sensor), color=INK, size=4)
    return framed(drawn, minutes, [*sensor, *twin, *model])


def about_zero(x: Numbers, y: Numbers, x_label: str) -> Chart:
    """Residuals."""
    drawn = axes(x_label, height=150)
    drawn.line([min(x), max(x)], [0.0, 0.0], line_color=GREY)
    drawn.scatter(list(x), list(y), color=BLUE, size=4)
    return framed(drawn, x, [*y, 0.0])


def before_and_after(n: Numbers, share: Numbers, sides: Sequence[tuple[Numbers, Numbers]], x_label: str) -> Chart:
    """Values before and after a replacement, with the median of either side."""
    drawn = axes(x_label)
    drawn.scatter(list(n), list(share), color=SKY, size=4, alpha=0.8)
    for side in sides:
        drawn.line(*map(list, side), line_color=BLUE, line_width=1.8)
    low, high = room(share, 0.08)
    drawn.segment([0], [low], [0], [high], line_color=GREEN, line_dash="dotted")
    drawn.scatter([0], [low + 0.03 * (high - low)], marker="triangle", color=GREEN, size=10)
    return framed(drawn, n, share, 0.08)


def framed(drawn: Any, x: Numbers, y: Numbers, pad: float = 0.05) -> Chart:
    """The figure, ranges about what it shows."""
    return {"figure": packed(drawn), "fill": {"x": room(x), "y": room(y, pad)}}


def room(values: Numbers, pad: float = 0.05) -> tuple[float, float]:
    """Least and greatest of `values` with some room; 0 to 1 where there is none."""
    if not len(values):
        return 0.0, 1.0
    low, high = min(values), max(values)
    more = (high - low) * pad or abs(high) * pad or 1.0
    return round(low - more, 6), round(high + more, 6)
