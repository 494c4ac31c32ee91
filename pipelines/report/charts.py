"""Build zoomable charts: Bokeh figures whose data sources the page fills when a chart comes into view."""

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
"""Colours of Okabe and Ito; the page replaces them by lighter ones on a dark ground."""
INK, LINE = "#1a1a1a", "#d5d5d5"
Numbers = Sequence[float]
Chart = dict[str, Any]


def chart_script() -> str:
    """Return the script that draws the charts in the browser."""
    return "".join(Resources(mode="inline", components=["bokeh"]).js_raw)


def figure_json(plot: Any) -> dict[str, Any]:
    """Serialise a figure to the same JSON in every run, by renumbering Bokeh's ids."""
    item = json_item(plot)
    text = json.dumps({"doc": item["doc"], "root_id": item["root_id"]}, ensure_ascii=False)
    ids: dict[str, str] = {}
    text = re.sub(r'"p(\d+)"', lambda m: ids.setdefault(m[0], f'"c{len(ids)}"'), text)
    return dict(json.loads(text))


def source(name: str, *columns: str) -> ColumnDataSource:
    """Create an empty data source that the page fills."""
    return ColumnDataSource({c: [] for c in columns}, name=name)


def axes(x_label: str = "", *, time: bool = False, height: int = 230) -> Any:
    """Create an empty figure in the page's style; it zooms along x only, so that marks at the edges stay there."""
    plot = figure(
        height=height, sizing_mode="stretch_width", tools="xpan,xwheel_zoom,xbox_zoom,reset", active_drag="xbox_zoom",
        x_range=Range1d(name="x", bounds="auto"), y_range=Range1d(name="y"), toolbar_location="above",
        output_backend="svg", x_axis_type="datetime" if time else "linear", min_border=0,
        background_fill_alpha=0.0, border_fill_alpha=0.0, outline_line_color=None,
    )  # fmt: skip
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.xaxis.axis_label = x_label or None
    for axis in plot.axis:
        axis.axis_line_color = axis.major_tick_line_color = axis.major_label_text_color = INK
        axis.axis_label_text_color = INK
        axis.minor_tick_line_color = None
        axis.axis_label_text_font_style = "normal"
        axis.major_label_text_font_size = axis.axis_label_text_font_size = "11px"
    plot.xgrid.grid_line_color = None
    plot.ygrid.grid_line_color = LINE
    plot.yaxis.ticker = BasicTicker(desired_num_ticks=5)
    plot.yaxis.formatter = BasicTickFormatter(use_scientific=False)
    if time:
        plot.xaxis.ticker = DatetimeTicker(desired_num_ticks=4)
        plot.xaxis.formatter = DatetimeTickFormatter(
            hours="%m-%d %H:%M", days="%m-%d", months="%Y-%m", years="%Y", context=None
        )
    return plot


def track() -> dict[str, Any]:
    """Build the chart of a unit's loss over time: fleet's band, other pack, own loss, events, forecast."""
    plot = axes(time=True)
    fleet, own = source("fleet", "x", "low", "high"), source("own", "x", "y", "low", "high")
    other, cc = source("other", "x", "y"), source("cc", "x", "y")
    plot.varea("x", "low", "high", source=fleet, fill_color=GREY, fill_alpha=0.16)
    plot.varea("x", "low", "high", source=own, fill_color=BLUE, fill_alpha=0.25)
    plot.line("x", "y", source=other, line_color=GREY, line_width=1.2, line_dash="dotted")
    plot.line("x", "y", source=cc, line_color=ORANGE, line_width=1.5, line_dash="dashed")
    line = plot.line("x", "y", source=own, line_color=BLUE, line_width=1.8)
    plot.scatter("x", "y", source=source("alone", "x", "y"), color=BLUE, size=6)
    _events(plot)
    ahead = source("ahead", "low", "mid", "high", "y")
    plot.segment("low", "y", "high", "y", source=ahead, line_color=VERMILLION, line_width=3)
    plot.scatter("mid", "y", source=ahead, color=VERMILLION, size=8)
    tooltips = [(_("day"), "@x{%F}"), (_("lost"), "@y{0.0} %"), (_("90 %"), _("@low{0.0} to @high{0.0} %"))]
    plot.add_tools(
        HoverTool(
            renderers=[line], tooltips=tooltips, formatters={"@x": "datetime"}, mode="vline", line_policy="nearest"
        )
    )
    return figure_json(plot)


def _events(plot: Any) -> None:
    """Draw alerts and messages at the top of the frame, work at its bottom."""
    events = source("events", "x", "y", "top", "bottom", "marker", "colour", "letter", "text")
    plot.segment("x", "bottom", "x", "top", source=events, line_color="colour", line_dash="dotted", line_width=1)
    signs = plot.scatter("x", "y", source=events, marker="marker", color="colour", size=10)
    letters = {"text_font_size": "11px", "text_align": "center", "y_offset": -8}
    plot.text("x", "y", "letter", source=events, text_color="colour", **letters)
    plot.add_tools(HoverTool(renderers=[signs], tooltips=[("", "@text")]))


def cloud(x: Numbers, y: Numbers, x_label: str, line: tuple[Numbers, Numbers] | None = None) -> Chart:
    """Build a scatter chart, with a line where there is one."""
    plot = axes(x_label)
    plot.scatter(list(x), list(y), color=BLUE, alpha=0.55, size=4)
    if line is not None:
        plot.line(*map(list, line), line_color=VERMILLION, line_width=1.8)
    return framed(plot, x, y)


def over_cruise(minutes: Numbers, sensor: Numbers, twin: Numbers, model: Numbers) -> Chart:
    """Build the chart of a sensor against twin and model."""
    plot = axes(height=200)
    plot.line(list(minutes), list(model), line_color=ORANGE, line_dash="dashed", line_width=1.6)
    plot.line(list(minutes), list(twin), line_color=BLUE, line_width=1.6)
    plot.scatter(list(minutes), list(sensor), color=INK, size=4)
    return framed(plot, minutes, [*sensor, *twin, *model])


def about_zero(x: Numbers, y: Numbers, x_label: str) -> Chart:
    """Build a chart of residuals."""
    plot = axes(x_label, height=150)
    plot.line([min(x), max(x)], [0.0, 0.0], line_color=GREY)
    plot.scatter(list(x), list(y), color=BLUE, size=4)
    return framed(plot, x, [*y, 0.0])


def before_and_after(n: Numbers, share: Numbers, sides: Sequence[tuple[Numbers, Numbers]], x_label: str) -> Chart:
    """Build the chart of values before and after a replacement, with the median of either side."""
    plot = axes(x_label)
    plot.scatter(list(n), list(share), color=SKY, size=4, alpha=0.8)
    for side in sides:
        plot.line(*map(list, side), line_color=BLUE, line_width=1.8)
    low, high = room(share, 0.08)
    plot.segment([0], [low], [0], [high], line_color=GREEN, line_dash="dotted")
    plot.scatter([0], [low + 0.03 * (high - low)], marker="triangle", color=GREEN, size=10)
    return framed(plot, n, share, 0.08)


def framed(plot: Any, x: Numbers, y: Numbers, pad: float = 0.05) -> Chart:
    """Return the figure with ranges around its data."""
    return {"figure": figure_json(plot), "fill": {"x": room(x), "y": room(y, pad)}}


def room(values: Numbers, pad: float = 0.05) -> tuple[float, float]:
    """Return the range of `values` with a margin; 0 to 1 where there are none."""
    if not len(values):
        return 0.0, 1.0
    low, high = min(values), max(values)
    more = (high - low) * pad or abs(high) * pad or 1.0
    return round(low - more, 6), round(high + more, 6)
