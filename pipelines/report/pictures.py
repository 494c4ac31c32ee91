"""Pictures of a night for Dagster: the packs most in need, how they wear, and Figure 16, drawn as the report draws.

They are text (SVG), some kilobytes for a fleet of any size and made in milliseconds, for every night keeps its own.
"""

import base64
from typing import Any

import dagster as dg
import polars as pl

from hdt_core.twin.crossing import PACK
from pipelines.report import svg
from pipelines.report.html import Html, join, tag
from pipelines.report.replacement import around_replacement

PACKS, COLUMNS, POINTS, Z_90 = 6, 2, 120, 1.645
DRAWN = (
    "hx_fouling", "hx_fouling_sd", "hx_fouling_flight", "cc_efficiency_loss", "cc_efficiency_loss_sd",
    "hx_out_sensor_minus_dsm_k", "hx_out_sensor_minus_twin_k",
)  # fmt: skip
"""Features that pictures show."""
_STYLE = ".grid{stroke:#e4e4e4;fill:none}.axis{stroke:#444;fill:none}text{font:11px sans-serif}.name{font-weight:bold}"


def night_pictures(features: pl.DataFrame, prognoses: pl.DataFrame, maintenance: pl.DataFrame) -> dict[str, Any]:
    """Health and outlet residuals of the packs most in need, and Figure 16, as Dagster shows them."""
    packs = _most_in_need(prognoses)
    flown = features.select(*PACK, "departed_at", *DRAWN).sort("departed_at")
    own = [
        (f"{p['tail']} pack {p['pack']}", flown.filter(pl.all_horizontal(pl.col(k) == p[k] for k in PACK)))
        for p in packs
    ]
    pictures = {
        "health_over_flights": [_health(name, rows) for name, rows in own],
        "outlet_residuals": [_residuals(name, rows) for name, rows in own],
        "figure_16": _figure_16(flown, maintenance),
    }
    return {name: _as_markdown(charts) for name, charts in pictures.items() if charts}


def _most_in_need(prognoses: pl.DataFrame) -> list[dict[str, Any]]:
    """Packs whose exchanger is likeliest to raise a message soon, by its last prognosis."""
    last = prognoses.filter(component="HX").sort("departed_at").group_by(PACK).last()
    return last.sort("p_event_50", *PACK, descending=True, nulls_last=True).head(PACKS).select(PACK).to_dicts()


def _health(name: str, rows: pl.DataFrame) -> Html:
    """Conductance lost with its 90 % band, and the compressor's efficiency lost."""
    hx, cc = (_thin(rows.drop_nulls([c, f"{c}_sd"])) for c in ("hx_fouling", "cc_efficiency_loss"))
    at = _seconds(rows)
    top = max([40.0, *(100 * hx["hx_fouling"] + 5).to_list()])
    chart = svg.Chart(svg.span(at, 0.01), (-10.0, top), name, height=206)
    lost, sd = 100 * hx["hx_fouling"], 100 * Z_90 * hx["hx_fouling_sd"]
    chart.band(list(zip(_seconds(hx), lost - sd, lost + sd, strict=True)), svg.BLUE)
    chart.line(list(zip(_seconds(cc), 100 * cc["cc_efficiency_loss"], strict=True)), svg.ORANGE, dash="5 2")
    chart.line(list(zip(_seconds(hx), lost, strict=True)), svg.BLUE)
    return _named(chart, svg.month_ticks(*chart.x, 5), "% lost: exchanger blue, compressor orange dashes")


def _residuals(name: str, rows: pl.DataFrame) -> Html:
    """Outlet temperature, sensor less model as built and sensor less twin."""
    model, twin = "hx_out_sensor_minus_dsm_k", "hx_out_sensor_minus_twin_k"
    seen = _thin(rows.drop_nulls([model, twin]))
    at = _seconds(seen)
    chart = svg.Chart(svg.span(at, 0.01), svg.span([*seen[model], *seen[twin], 0.0]), name, height=206)
    chart.line([(chart.x[0], 0), (chart.x[1], 0)], svg.GREY, width=1)
    chart.line(list(zip(at, seen[model], strict=True)), svg.ORANGE, dash="5 2")
    chart.dots(list(zip(at, seen[twin], strict=True)), svg.BLUE)
    return _named(chart, svg.month_ticks(*chart.x, 5), "K: sensor less model orange, less twin blue")


def _figure_16(flown: pl.DataFrame, maintenance: pl.DataFrame) -> list[Html]:
    """Conductance over the flights before a replacement and after it; nothing where none is on record."""
    seen = flown.drop_nulls("hx_fouling_flight").with_columns(ua_share=1.0 - pl.col("hx_fouling_flight"))
    found = around_replacement(seen, maintenance)
    if found is None:
        return []
    work, rows = found
    n, share = rows["n"].to_list(), (100 * rows["ua_share"]).to_list()
    name = f"Figure 16: {work['tail']} pack {work['pack']}, exchanger replaced {work['done_on']}"
    chart = svg.Chart((min(n) - 3, max(n) + 3), svg.span(share, 0.08), name, width=640)
    chart.dots(list(zip(n, share, strict=True)), svg.BLUE, size=3)
    chart.mark(0, "work", svg.GREEN, "replaced", "R")
    return [_named(chart, svg.number_ticks(*chart.x), "UA, % of design, over flights from the replacement")]


def _thin(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.gather_every(max(1, -(-rows.height // POINTS)))


def _seconds(rows: pl.DataFrame) -> list[float]:
    return (rows["departed_at"].dt.epoch("ms") / 1000.0).to_list()


def _named(chart: svg.Chart, x_marks: list[tuple[float, str]], y_label: str) -> Html:
    """A chart with its name under it, for a picture has no caption."""
    name = tag("text", chart.label, x=svg.LEFT, y=chart.height - 4, class_="name")
    return join(tag("svg", chart.frame(x_marks, y_label), *chart.parts, name, width=chart.width, height=chart.height))


def _as_markdown(charts: list[Html]) -> dg.MarkdownMetadataValue:
    """Charts side by side, as one picture."""
    wide, high = 410, 240
    placed = [
        tag("g", c, transform=f"translate({wide * (i % COLUMNS)} {high * (i // COLUMNS)})")
        for i, c in enumerate(charts)
    ]
    size = {"width": max(650, wide * min(len(charts), COLUMNS)), "height": high * -(-len(charts) // COLUMNS)}
    ground = tag("rect", fill="white", **size)
    whole = tag("svg", tag("style", Html(_STYLE)), ground, *placed, xmlns="http://www.w3.org/2000/svg", **size)
    return dg.MetadataValue.md(f"![picture](data:image/svg+xml;base64,{base64.b64encode(whole.encode()).decode()})")
