"""Build zoomable charts of the paper's figures: Bokeh figures that the page draws when they come into view."""

import json
import re
from collections.abc import Sequence
from typing import Any

from bokeh.embed import json_item
from bokeh.models import BasicTicker, BasicTickFormatter, Range1d
from bokeh.plotting import figure
from bokeh.resources import Resources

BLUE, ORANGE, GREEN, VERMILLION, SKY, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#6b6b6b",
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


def axes(x_label: str, height: int = 230) -> Any:
    """Create an empty figure in the page's style; it zooms along x only, so that marks at the edges stay there."""
    plot = figure(
        height=height, sizing_mode="stretch_width", tools="xpan,xwheel_zoom,xbox_zoom,reset", active_drag="xbox_zoom",
        x_range=Range1d(bounds="auto"), y_range=Range1d(), toolbar_location="above",
        output_backend="svg", min_border=0,
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
    return plot


def cloud(x: Numbers, y: Numbers, x_label: str, line: tuple[Numbers, Numbers] | None = None) -> Chart:
    """Build a scatter chart, with a line where there is one."""
    plot = axes(x_label)
    plot.scatter(list(x), list(y), color=BLUE, alpha=0.55, size=4)
    if line is not None:
        plot.line(*map(list, line), line_color=VERMILLION, line_width=1.8)
    return framed(plot, x, y)


def over_cruise(minutes: Numbers, sensor: Numbers, twin: Numbers, model: Numbers) -> Chart:
    """Build the chart of a sensor against twin and model."""
    plot = axes("", height=200)
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
    (plot.x_range.start, plot.x_range.end), (plot.y_range.start, plot.y_range.end) = room(x), room(y, pad)
    return figure_json(plot)


def room(values: Numbers, pad: float = 0.05) -> tuple[float, float]:
    """Return the range of `values` with a margin; 0 to 1 where there are none."""
    if not len(values):
        return 0.0, 1.0
    low, high = min(values), max(values)
    more = (high - low) * pad or abs(high) * pad or 1.0
    return round(low - more, 6), round(high + more, 6)
