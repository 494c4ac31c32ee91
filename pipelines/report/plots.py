"""Draw figures 12, 13, 15 and 16 of the paper from this fleet's flights, for the report and for Dagster."""

import base64
import io
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.calibration.compressor import CompressorFit
from hdt_core.calibration.dsm import Dsm
from hdt_core.health.residuals import residuals
from hdt_core.records.keys import PACK
from hdt_core.records.unit_index import date_entries
from pipelines.report.units import to_us
from pipelines.words import _

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE, ORANGE, GREEN, VERMILLION, SKY, GREY, INK = (
    "#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#6b6b6b", "#1a1a1a",
)  # fmt: skip
"""Colours of Okabe and Ito."""
MOST_DOTS = 700
FLIGHTS_BEFORE, FLIGHTS_AFTER = 200, 40
DPI, COLOURS = 72, 24
MARGINS = (0.12, 0.14, 0.98, 0.96)
"""Left, bottom, right, top; automatic margins draw the figure twice."""


def figure_12(twin_flights: pl.DataFrame, fit: CompressorFit | None, system: str = "si") -> "Figure":
    """Draw the compressor inlet's identifiable group of each flight over the diffuser's position, and the fleet's.

    `system` is one of `units.SYSTEMS`.
    """
    return _over_diffuser(twin_flights, "group_m3", fit.group_at_m3 if fit else None, "A·D·tan β", "10⁻³ m³", system)


def figure_13(twin_flights: pl.DataFrame, fit: CompressorFit | None, system: str = "si") -> "Figure":
    """Draw the effective diameter of each flight, and equation (6)."""
    return _over_diffuser(
        twin_flights, "diameter_m", fit.diameter_m if fit else None, _("effective diameter"), "mm", system
    )


def _over_diffuser(
    twin_flights: pl.DataFrame,
    column: str,
    line: Callable[[Array], Array] | None,
    name: str,
    unit: str,
    system: str,
) -> "Figure":
    """Draw a column, a dot a flight, and a fitted line over the positions on record; `unit` is a thousandth of its."""
    figure, axes = _figure()
    rows = _thinned(twin_flights.drop_nulls(["vda_counts", column]))
    at = rows["vda_counts"].to_numpy()
    convert, unit = _scale(unit, system)
    axes.plot(at, convert(1e3 * rows[column].to_numpy()), ".", ms=5, alpha=0.5, color=BLUE, mew=0)
    if line and rows.height:
        ends = np.array([at.min(), at.max()])
        axes.plot(ends, convert(1e3 * line(ends)), color=VERMILLION)
    axes.set(xlabel=_("diffuser actuator, counts"), ylabel=f"{name}, {unit}")
    return figure


def _thinned(rows: pl.DataFrame) -> pl.DataFrame:
    return rows.gather_every(max(1, -(-rows.height // MOST_DOTS)))


def _scale(unit: str, system: str) -> tuple[Callable[[Array], Array], str]:
    """Return the conversion from `unit` to that of a system, and its name."""
    if system == "si":
        return lambda values: values, unit
    (zero, name), (one, _name) = to_us(0.0, unit), to_us(1.0, unit)
    return lambda values: values * (one - zero) + zero, name


def figure_15(samples: pl.DataFrame, system: str = "si") -> "Figure":
    """Draw the exchanger outlet over one cruise, sensor against model, and the residual beneath.

    `samples` are those of `outlet_residuals`.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.8))
    figure.subplots_adjust(*MARGINS, hspace=0.08)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=[2, 1])
    samples = _thinned(samples)  # a log of hours at 1 Hz would be megabytes of the page
    columns = (samples[c].to_numpy() for c in ("hx_out_k", "sensor_minus_twin", "sensor_minus_dsm"))
    sensor, twin_residual, model_residual = columns
    convert, unit = _scale("°C", system)
    minutes = (
        samples.select((pl.col("time_utc") - pl.col("time_utc").min()).dt.total_seconds()).to_series().to_numpy() / 60.0
    )
    for values, label, style in (
        (sensor, _("sensor"), {"ls": "", "marker": ".", "color": INK}),
        (sensor - twin_residual, _("twin"), {"color": BLUE}),
        (sensor - model_residual, _("model as built"), {"ls": "--", "color": ORANGE}),
    ):
        upper.plot(minutes, convert(values - 273.15), label=label, **style)
    upper.legend(frameon=False)
    upper.set_ylabel(_("exchanger outlet, {unit}", unit=unit))
    convert, unit = _scale("K", system)
    lower.axhline(0.0, color=GREY, lw=0.8)
    lower.plot(minutes, convert(twin_residual), ".", color=BLUE)
    lower.set(xlabel=_("minutes of cruise"), ylabel=_("sensor - twin, {unit}", unit=unit))
    return figure


def figure_16(flights: pl.DataFrame) -> "Figure":
    """Draw conductance over the flights before and after a replacement, and the median of nine on either side.

    `flights` are those of `around_replacement`.
    """
    figure, axes = _figure()
    share = 100 * flights["ua_share"]
    axes.plot(flights["n"], share, ".", ms=4, color=SKY)
    for side in (flights["n"] < 0, flights["n"] >= 0):
        axes.plot(flights["n"].filter(side), share.filter(side).rolling_median(9, min_samples=3), color=BLUE)
    axes.axvline(0.0, color=GREEN, ls=":")
    axes.set(xlabel=_("flights from the replacement"), ylabel=_("UA, % of design"))
    return figure


def _figure() -> tuple["Figure", "Axes"]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6))
    figure.subplots_adjust(*MARGINS)
    return figure, figure.subplots()


def as_svg(figure: "Figure") -> str:
    """Encode a figure as the address of an SVG image, the same bytes for the same figure."""
    import matplotlib as mpl

    image = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "hdt", "svg.fonttype": "none"}):
        figure.savefig(image, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(image.getvalue()).decode()}"


def as_png(figure: "Figure") -> str:
    """Encode a figure as the address of a PNG image, in few colours to stay small."""
    from PIL import Image

    image = io.BytesIO()
    small = io.BytesIO()
    figure.savefig(image, format="png", dpi=DPI)
    Image.open(image).convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
        small, format="png", optimize=True
    )
    return f"data:image/png;base64,{base64.b64encode(small.getvalue()).decode()}"


def outlet_residuals(cruise: pl.DataFrame, twin_flight: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Return cruise samples of one flight and pack with their outlet residuals, `sensor_minus_twin` and `_dsm`. [K]

    Each sample is passed to the core as a flight of one sample.
    """
    alone = cruise.with_columns(sample=pl.format("{}", pl.int_range(pl.len())))
    flights = alone.select("sample").join(twin_flight, how="cross")
    samples, twins = (f.drop("flight_id").rename({"sample": "flight_id"}) for f in (alone, flights))
    kinds = ("sensor_minus_twin", "sensor_minus_dsm")
    means = (pl.col("mean").filter(pl.col("kind") == kind).first().alias(kind) for kind in kinds)
    rows = residuals(samples, twins, dsm).filter(signal="hx_out_k").group_by(sample="flight_id").agg(*means)
    return alone.join(rows, on="sample", validate="m:1").drop_nulls(kinds).sort("time_utc")


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
        after = rows.filter(pl.col("n") >= 0).select(level)
        last = rows.filter(pl.col("n") < 0).tail(20).select(level)
        gain = after.item() - last.item() if after.item() is not None and last.item() is not None else None
        if gain is not None and rows.filter(pl.col("n") < 0).height >= 20 and (best is None or gain > best[0]):
            best = gain, w, rows
    return None if best is None else best[1:]
