"""Draw the calibration's figures for Dagster: 12, 13 and 15 of the paper, from this fleet's flights."""

import base64
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import dagster as dg
import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.drift_audit import audit_drift
from hdt_core.calibration.dsm import Dsm
from hdt_core.health.residuals import residuals
from hdt_core.records.keys import FLIGHT_PACK, PACK
from hdt_core.records.unit_index import date_entries

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_DOTS = 4_000
FLIGHTS_BEFORE, FLIGHTS_AFTER = 200, 40
DPI, COLOURS = 72, 24
MARGINS = (0.12, 0.12, 0.98, 0.92)
"""Left, bottom, right, top; automatic margins draw the figure twice."""


def calibration_metadata(
    samples: pl.DataFrame, twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm
) -> dict[str, Any]:
    """Return figures, the comparison of equation (6)'s forms and the drift audit as Dagster's metadata.

    Parameters
    ----------
    samples, twin_flights : DataFrame
        Of the baseline: samples of the leg filter, and their estimates by `estimate_flights`.
    """
    audit = audit_drift(twin_flights, maintenance, dsm)
    figures = {
        "figure_12": figure_12(twin_flights, dsm),
        "figure_13": figure_13(twin_flights, dsm),
        "figure_15": figure_15(samples, twin_flights, dsm),
    }
    return {name: as_markdown(figure) for name, figure in figures.items()} | {
        "equation_6": dg.MetadataValue.md(_table(pl.DataFrame(dsm.compressor.forms))),
        "drift_audit": dg.MetadataValue.md(_table(audit)),
        "units_that_drift": int(audit["drifts"].sum()),
    }


def figure_12(twin_flights: pl.DataFrame, dsm: Dsm) -> "Figure":
    """Draw the compressor inlet's identifiable group of each flight, and the fleet's."""
    figure, axes = _figure()
    rows = _thinned(twin_flights.drop_nulls(["vda_counts", "group_m3"]))
    axes.plot(rows["vda_counts"], 1e3 * rows["group_m3"], ".", ms=3, alpha=0.4)
    c = dsm.compressor
    _draw_line(axes, rows, c.group_at_m3)
    axes.set(xlabel="diffuser actuator, counts", ylabel="A·D·tan β, 10⁻³ m³")
    at = f"at {c.vda_counts:.0f} counts"
    axes.set_title(f"Figure 12: inlet group, {1e3 * c.group_m3:.4f} ± {1e3 * c.group_sd_m3:.4f} {at}")
    return figure


def figure_13(twin_flights: pl.DataFrame, dsm: Dsm) -> "Figure":
    """Draw the effective diameter of each flight and equation (6)."""
    figure, axes = _figure()
    rows = _thinned(twin_flights.drop_nulls(["vda_counts", "diameter_m"]))
    axes.plot(rows["vda_counts"], 1e3 * rows["diameter_m"], ".", ms=3, alpha=0.4)
    c = dsm.compressor
    _draw_line(axes, rows, c.diameter_m)
    axes.set(xlabel="diffuser actuator, counts", ylabel="effective diameter, mm")
    axes.set_title(
        f"Figure 13: {c.intercept_m:.4f} m {c.slope_m_per_count:+.3g} m/count, "
        f"error {1e3 * c.mae_m:.2f} mm, R² {c.r_squared:.2f}"
    )
    return figure


def _draw_line(axes: "Axes", rows: pl.DataFrame, value_at: Callable[[Array], Array]) -> None:
    """Draw a fitted line over the positions on record."""
    if rows.height:
        ends = np.array([rows["vda_counts"].min(), rows["vda_counts"].max()], float)
        axes.plot(ends, 1e3 * value_at(ends), color="C1")


def figure_15(samples: pl.DataFrame, twin_flights: pl.DataFrame, dsm: Dsm) -> "Figure":
    """Draw the exchanger outlet over one cruise, sensor against model, and the residual beneath."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.8))
    figure.subplots_adjust(*MARGINS, hspace=0.08)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    cruise = _segment(samples)
    rows = outlet_residuals(
        cruise, twin_flights.join(cruise.select(FLIGHT_PACK).head(1), on=FLIGHT_PACK, validate="m:1"), dsm
    )
    if rows.height:
        minute = (rows["time_utc"] - rows["time_utc"][0]).dt.total_seconds().to_numpy() / 60.0
        sensor = rows["hx_out_k"].to_numpy() - 273.15
        upper.plot(minute, sensor, ".", color="black", label="sensor")
        upper.plot(minute, sensor - rows["sensor_minus_twin"].to_numpy(), label="twin")
        upper.plot(minute, sensor - rows["sensor_minus_dsm"].to_numpy(), "--", label="model as built")
        upper.legend()
        lower.plot(minute, rows["sensor_minus_twin"].to_numpy(), ".")
        upper.set_title(f"Figure 15: {rows['flight_id'][0]}, pack {rows['pack'][0]}")
    lower.axhline(0.0, color="grey", lw=0.8)
    upper.set_ylabel("exchanger outlet, °C")
    lower.set(xlabel="minutes of cruise", ylabel="sensor - twin, K")
    return figure


def outlet_residuals(cruise: pl.DataFrame, twin_flight: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Return cruise samples of one flight and pack with their outlet residuals, `sensor_minus_twin` and `_dsm`. [K]

    Each sample is passed to the core as a flight of one sample.
    """
    alone = cruise.with_columns(sample=pl.format("{}", pl.int_range(pl.len())))
    flights = alone.select("sample").join(twin_flight, how="cross")
    samples, twins = (f.drop("flight_id").rename({"sample": "flight_id"}) for f in (alone, flights))
    rows = residuals(samples, twins, dsm).filter(signal="hx_out_k").pivot("kind", index="flight_id", values="mean")
    if not rows.height:
        return alone.clear()
    wide = alone.join(rows.rename({"flight_id": "sample"}), on="sample", validate="m:1")
    return wide.drop_nulls(["sensor_minus_twin", "sensor_minus_dsm"]).sort("time_utc")


def _segment(samples: pl.DataFrame) -> pl.DataFrame:
    """Select the cruise of the flight and pack with the most samples: continuous logs first."""
    cruise = samples.filter(pl.col("monitored") & (pl.col("phase") == "cruise")).drop_nulls("hx_out_k")
    ranked = cruise.group_by(FLIGHT_PACK).agg(pl.col("n_averaged").max(), pl.len().alias("n"))
    best = ranked.sort(pl.col("n_averaged") > 1, "n", *FLIGHT_PACK, descending=True).head(1)
    return cruise.join(best.select(FLIGHT_PACK), on=FLIGHT_PACK, how="semi")


def _figure() -> tuple["Figure", "Axes"]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.0))
    figure.subplots_adjust(*MARGINS)
    return figure, figure.subplots()


def _thinned(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.gather_every(max(1, -(-rows.height // MOST_DOTS)))


def as_markdown(figure: "Figure") -> dg.MarkdownMetadataValue:
    """Encode a figure as an image in Markdown, in few colours to stay small."""
    from PIL import Image

    image, small = io.BytesIO(), io.BytesIO()
    figure.savefig(image, format="png", dpi=DPI)
    Image.open(image).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
        small, format="png", optimize=True
    )
    return dg.MetadataValue.md(f"![figure](data:image/png;base64,{base64.b64encode(small.getvalue()).decode()})")


def _table(frame: pl.DataFrame) -> str:
    """Format a small table as Markdown."""
    cells = [[f"{v:.4g}" if isinstance(v, float) else str(v) for v in row] for row in frame.rows()]
    lines = [frame.columns, ["---"] * frame.width, *cells]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def around_replacement(flights: pl.DataFrame, maintenance: pl.DataFrame) -> tuple[dict[str, Any], pl.DataFrame] | None:
    """Find the replacement of an exchanger with the deepest loss before it, and the flights around it.

    Parameters
    ----------
    flights : DataFrame
        Sorted by departure; `ua_share` is the measured conductance over the expected one.
    maintenance : DataFrame
        The log of work.

    Returns
    -------
    dict and DataFrame, or None
        The line of the log; its pack's flights with `n`, counted from 0 at the first flight after it.
    """
    best: tuple[float, dict[str, Any], pl.DataFrame] | None = None
    work = date_entries(maintenance.filter(component="HX", action="REPLACED").drop_nulls("pack"))
    worked_on = flights.join(work, on=PACK, how="semi", maintain_order="left").partition_by(PACK, as_dict=True)
    for w in work.to_dicts():
        own = worked_on.get(tuple(w[k] for k in PACK), flights.clear())
        before = own["departed_at"] < w["counts_from"]
        rows = own.with_columns(n=pl.int_range(pl.len()) - int(before.sum())).filter(
            pl.col("n").is_between(-FLIGHTS_BEFORE, FLIGHTS_AFTER)
        )
        level = pl.col("ua_share").log().median()
        after, last = rows.filter(pl.col("n") >= 0).select(level), rows.filter(pl.col("n") < 0).tail(20).select(level)
        gain = after.item() - last.item() if after.item() is not None and last.item() is not None else None
        if gain is not None and rows.filter(pl.col("n") < 0).height >= 20 and (best is None or gain > best[0]):
            best = gain, w, rows
    return None if best is None else best[1:]
