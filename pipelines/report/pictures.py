"""Draw the pictures of a calibration and a night for Dagster.

Dagster's page runs no script of ours, so they are images; they are small because every night stores its own.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import dagster as dg
import polars as pl

from hdt_core.calibration.drift_audit import audit_drift
from hdt_core.calibration.dsm import Dsm
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.robust import Z_90
from pipelines.report.plots import (
    around_replacement,
    as_png,
    figure_12,
    figure_13,
    figure_15,
    figure_16,
    outlet_residuals,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PACKS, COLUMNS, POINTS = 6, 2, 80
PICTURE_FEATURES = (
    "hx_fouling", "hx_fouling_sd", "hx_fouling_flight", "cc_efficiency_loss", "cc_efficiency_loss_sd",
    "hx_out_sensor_minus_dsm_k", "hx_out_sensor_minus_twin_k",
)  # fmt: skip
"""Features on the pictures."""
Pack = tuple[str, pl.DataFrame]


def calibration_metadata(
    samples: pl.DataFrame, twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm
) -> dict[str, Any]:
    """Return figures, the comparison of equation (6)'s forms and the drift audit as Dagster's metadata.

    Parameters
    ----------
    samples, twin_flights : DataFrame
        Of the baseline: samples of the leg filter, and their estimates by `estimate_flights`.
    """
    audit, cruise = audit_drift(twin_flights, maintenance, dsm), _longest_cruise(samples)
    own = twin_flights.join(cruise.select(FLIGHT_PACK).head(1), on=FLIGHT_PACK, validate="m:1")
    figures = {
        "figure_12": figure_12(twin_flights, dsm.compressor),
        "figure_13": figure_13(twin_flights, dsm.compressor),
        "figure_15": figure_15(outlet_residuals(cruise, own, dsm)),
    }
    return {name: _markdown(figure) for name, figure in figures.items()} | {
        "equation_6": dg.MetadataValue.md(_table(pl.DataFrame(dsm.compressor.forms))),
        "drift_audit": dg.MetadataValue.md(_table(audit)),
        "units_that_drift": int(audit["drifts"].sum()),
    }


def _longest_cruise(samples: pl.DataFrame) -> pl.DataFrame:
    """Select the cruise of the flight and pack with the most samples: continuous logs first."""
    cruise = samples.filter(pl.col("monitored") & (pl.col("phase") == "cruise")).drop_nulls("hx_out_k")
    ranked = cruise.group_by(FLIGHT_PACK).agg(pl.col("n_averaged").max(), pl.len().alias("n"))
    best = ranked.sort(pl.col("n_averaged") > 1, "n", *FLIGHT_PACK, descending=True).head(1)
    return cruise.join(best.select(FLIGHT_PACK), on=FLIGHT_PACK, how="semi")


def _markdown(figure: "Figure") -> dg.MarkdownMetadataValue:
    return dg.MetadataValue.md(f"![figure]({as_png(figure)})")


def _table(frame: pl.DataFrame) -> str:
    """Format a small table as Markdown."""
    cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row] for row in frame.rows()]
    lines = [frame.columns, ["---"] * frame.width, *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def night_pictures(features: pl.DataFrame, prognoses: pl.DataFrame, maintenance: pl.DataFrame) -> dict[str, Any]:
    """Return the figures of `night_figures` as Dagster's metadata."""
    return {name: _markdown(f) for name, f in night_figures(features, prognoses, maintenance).items()}


def night_figures(features: pl.DataFrame, prognoses: pl.DataFrame, maintenance: pl.DataFrame) -> dict[str, "Figure"]:
    """Draw health and outlet residuals of the packs most in need, and Figure 16; none without flights."""
    packs = _most_in_need(prognoses)
    flights = features.select(*PACK, "departed_at", *PICTURE_FEATURES).sort("departed_at")
    own = [
        (f"{p['tail']} pack {p['pack']}", flights.filter(pl.all_horizontal(pl.col(k) == p[k] for k in PACK)))
        for p in packs
    ]
    grids = {"health_over_flights": _grid(own, _health), "outlet_residuals": _grid(own, _residuals)} if own else {}
    shares = flights.drop_nulls("hx_fouling_flight").with_columns(ua_share=1.0 - pl.col("hx_fouling_flight"))
    replacement = around_replacement(shares, maintenance)
    return grids | ({"figure_16": _titled_figure_16(*replacement)} if replacement else {})


def _most_in_need(prognoses: pl.DataFrame) -> list[dict[str, Any]]:
    """Select the packs whose exchanger is likeliest to raise a message soon, by its last prognosis."""
    last = prognoses.filter(component="HX").sort("departed_at").group_by(PACK).last()
    return last.sort("p_event_50", *PACK, descending=True, nulls_last=True).head(PACKS).select(PACK).to_dicts()


def _grid(own: Sequence[Pack], draw: Any) -> "Figure":
    """Draw a small chart for every pack."""
    from matplotlib.figure import Figure

    rows = -(-len(own) // COLUMNS)
    figure = Figure(figsize=(8.6, 2.3 * rows))
    figure.subplots_adjust(0.08, 0.05, 0.96, 1.0 - 0.12 / rows, 0.2, 0.35)  # automatic layout takes 1 s
    for axes, pack in zip(figure.subplots(rows, COLUMNS, squeeze=False).flat, own, strict=False):
        draw(axes, *pack)
    for axes in figure.axes[len(own) :]:
        axes.set_visible(False)
    for axes in figure.axes:
        axes.tick_params(labelsize=7)
    return figure


def _days(axes: "Axes", rows: pl.DataFrame) -> pl.Series:
    """Return days of departure as numbers and label three of them; automatic ticks take 1 s."""
    days = rows["departed_at"].dt.epoch("us") / 86_400e6
    if rows.height:
        ends = rows["departed_at"][0], rows["departed_at"][-1]
        middle = ends[0] + 0.5 * (ends[1] - ends[0])
        axes.set_xticks([days[0], 0.5 * (days[0] + days[-1]), days[-1]])
        axes.set_xticklabels([f"{day:%Y-%m-%d}" for day in (ends[0], middle, ends[1])])
    return days


def _health(axes: "Axes", name: str, rows: pl.DataFrame) -> None:
    """Draw conductance lost with its 90 % band, and the compressor's efficiency lost."""
    hx, cc = (_thin(rows.drop_nulls([c, f"{c}_sd"])) for c in ("hx_fouling", "cc_efficiency_loss"))
    loss, half_width = 100 * hx["hx_fouling"], 100 * Z_90 * hx["hx_fouling_sd"]
    day = _days(axes, hx)
    axes.fill_between(day, loss - half_width, loss + half_width, color="C0", alpha=0.22, lw=0)
    axes.plot(day, loss, color="C0", lw=1.2)
    axes.plot(_days(axes, cc), 100 * cc["cc_efficiency_loss"], "--", color="C1", lw=1.2)
    axes.set_ylim(-10.0, max([40.0, *(loss + 5).to_list()]))
    axes.set_title(name, fontsize=8)
    axes.set_ylabel("% lost: exchanger,\ncompressor dashed", fontsize=7)


def _residuals(axes: "Axes", name: str, rows: pl.DataFrame) -> None:
    """Draw outlet temperature, sensor less model as built and sensor less twin."""
    model, twin = "hx_out_sensor_minus_dsm_k", "hx_out_sensor_minus_twin_k"
    flights = _thin(rows.drop_nulls([model, twin]))
    day = _days(axes, flights)
    axes.axhline(0.0, color="grey", lw=0.8)
    axes.plot(day, flights[model], "--", color="C1", lw=1.2)
    axes.plot(day, flights[twin], ".", color="C0", ms=2)
    axes.set_title(name, fontsize=8)
    axes.set_ylabel("K: sensor less model\ndashed, less twin dots", fontsize=7)


def _titled_figure_16(work: dict[str, Any], rows: pl.DataFrame) -> "Figure":
    """Draw figure 16 with the pack and the day in its title."""
    figure = figure_16(rows)
    title = f"Figure 16: {work['tail']} pack {work['pack']}, exchanger replaced {work['done_on']}"
    figure.axes[0].set_title(title, fontsize=9)
    figure.subplots_adjust(top=0.9)
    return figure


def _thin(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.gather_every(max(1, -(-rows.height // POINTS)))
