"""Build the paper's figures 12, 13, 15 and 16 from this fleet's flights."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import polars as pl
from markupsafe import Markup

from hdt_core.calibration.compressor_fit import CompressorFit
from pipelines.report import charts, words
from pipelines.report.facts import Facts
from pipelines.report.plots import around_replacement, outlet_residuals
from pipelines.report.templating import html_text
from pipelines.report.units import both, estimate, quantity, to_us
from pipelines.words import _, several

POINTS = 700
Figure = dict[str, Any]
"""Title, caption, and charts, each with a label and in both systems of units."""
Numbers = Sequence[float]


def figures(facts: Facts) -> list[Figure]:
    """Build all figures; one without data states what is missing."""
    return [f(facts) for f in (inlet_group, effective_diameter, outlet_temperature, coefficient_drift)]


def _figure(title: str, caption: Any, *parts: Figure) -> Figure:
    text = Markup(" ").join(caption) if isinstance(caption, list) else caption
    return {"title": title, "caption": text, "charts": parts}


def _in_both_units(unit: str, draw: Callable[..., charts.Chart], *columns: Numbers) -> Figure:
    """Draw a chart whose columns are all in one unit, and again in the other system."""
    name = to_us(0.0, unit)[1]
    chart = {"label": both(unit, name), "si": draw(*columns)}
    return chart if name == unit else chart | {"us": draw(*([to_us(v, unit)[0] for v in c] for c in columns))}


def _compressor(facts: Facts) -> CompressorFit | None:
    return facts.dsm.compressor if facts.dsm else None


def _nominal(facts: Facts, *columns: str) -> pl.DataFrame:
    """Return admitted flights with all of `columns`, evenly thinned."""
    rows = facts.twin.filter(pl.col("admitted")).drop_nulls(list(columns))
    return rows.gather_every(max(1, -(-rows.height // POINTS)))


def _cloud(rows: pl.DataFrame, column: str, unit: str, ends: list[float]) -> tuple[str, Figure]:
    """Draw nominal flights over the diffuser's position, with the line of the fleet's estimate through `ends`."""
    x = rows["vda_counts"].to_list()
    across = charts.room(x)

    def draw(y: Numbers, line: Numbers) -> charts.Chart:
        return charts.cloud(x, y, _("diffuser actuator, counts"), (across, line) if line else None)

    n = rows.height
    caption = several("{n} nominal flight shown, one dot a flight and pack.",
                   "{n} nominal flights shown, one dot a flight and pack.", n)  # fmt: skip
    return caption, _in_both_units(unit, draw, (1e3 * rows[column]).to_list(), ends)


def inlet_group(facts: Facts) -> Figure:
    """Build figure 12: the identifiable group of the inlet by flight, and the fleet's by position of the diffuser."""
    title = _("Figure 12: compressor inlet, A·D·tan β against diffuser position")
    rows = _nominal(facts, "vda_counts", "group_m3")
    if not rows.height:
        return _figure(title, _("No nominal flight has compressor flow, speed and diffuser position."))
    fit, ends = _compressor(facts), np.array(charts.room(rows["vda_counts"].to_list()))
    count, chart = _cloud(rows, "group_m3", "10⁻³ m³", (1e3 * fit.group_at_m3(ends)).tolist() if fit else [])
    caption = [
        html_text(count),
        html_text("Only this product of inlet area, diameter and blade angle is identifiable."),
    ]
    if fit:
        value = estimate(1e3 * fit.group_m3, 1e3 * fit.group_sd_m3, "10⁻³ m³")
        at = f"{fit.vda_counts:.0f}"
        caption.append(html_text("Line: the fleet's estimate, {value} at {counts} counts.", value=value, counts=at))
    return _figure(title, caption, chart)


def effective_diameter(facts: Facts) -> Figure:
    """Build figure 13: effective diameter of the impeller and its characterisation, equation (6)."""
    title = _("Figure 13: effective compressor diameter against diffuser position")
    rows = _nominal(facts, "vda_counts", "diameter_m")
    if not rows.height:
        return _figure(title, _("No nominal flight has exit pressure, speed and diffuser position."))
    fit, ends = _compressor(facts), np.array(charts.room(rows["vda_counts"].to_list()))
    count, chart = _cloud(rows, "diameter_m", "mm", (1e3 * fit.diameter_m(ends)).tolist() if fit else [])
    caption = [html_text(count)]
    if fit:
        at_zero, by = quantity(1e3 * fit.intercept_m, "mm", 1), quantity(1e5 * fit.slope_m_per_count, "mm", 3)
        line = html_text(
            "Line: equation (6) re-estimated, {at_zero} and {by} a hundred counts.", at_zero=at_zero, by=by
        )
        caption.append(line)
    return _figure(title, caption, chart)


def outlet_temperature(facts: Facts) -> Figure:
    """Build figure 15: outlet temperature of one flight, sensor against twin and model, with the residual."""
    title = _("Figure 15: outlet of the heat exchanger, sensor against model")
    cruise = _samples_with_residuals(facts)
    if cruise is None:
        return _figure(title, _("No flight has five samples of steady cruise under the model in service."))
    minutes = ((cruise["time_utc"] - cruise["time_utc"][0]).dt.total_seconds() / 60.0).to_list()
    sensor, rest = cruise["hx_out_k"] - 273.15, cruise["sensor_minus_twin"]
    columns = [s.to_list() for s in (sensor, sensor - rest, sensor - cruise["sensor_minus_dsm"])]
    first = cruise.row(0, named=True)
    caption = html_text(
        "Flight {flight}, pack {pack}, steady cruise ({kind}). Dots: sensor, bias not corrected. Blue: twin with this "
        "flight's conductance; orange dashes: model as built. Below: sensor minus twin, root mean square {rms}.",
        flight=first["flight_id"],
        pack=first["pack"],
        kind=_("continuous log, averaged") if (cruise["n_averaged"] > 1).any() else _("snapshots"),
        rms=quantity(float((rest**2).mean()) ** 0.5, "K", 2),  # type: ignore[arg-type]
    )
    return _figure(
        title,
        caption,
        _in_both_units("°C", lambda *c: charts.over_cruise(minutes, *c), *columns),
        _in_both_units("K", lambda c: charts.about_zero(minutes, c, _("minutes of cruise")), rest.to_list()),
    )


def _samples_with_residuals(facts: Facts) -> pl.DataFrame | None:
    """Return cruise samples of the replacement flight with their residuals."""
    if facts.dsm is None or not facts.segment.height or not facts.twin_flight.height:
        return None
    cruise = facts.segment.filter(pl.col("monitored") & (pl.col("phase") == "cruise")).drop_nulls("hx_out_k")
    samples = outlet_residuals(cruise, facts.twin_flight, facts.dsm)
    return samples if samples.height else None


def coefficient_drift(facts: Facts) -> Figure:
    """Build figure 16: conductance over the flights before and after a replacement."""
    title = _("Figure 16: conductance before and after a replacement")
    shares = facts.twin.with_columns(ua_share=pl.col("ua_w_k") / pl.col("ua_expected_w_k")).drop_nulls("ua_share")
    replacement = around_replacement(shares, facts["maintenance"])
    if replacement is None:
        return _figure(title, _("No heat exchanger was replaced with flights on record before it."))
    work, rows = replacement
    smooth = rows.with_columns(s=(100 * pl.col("ua_share")).rolling_median(9, min_samples=3).over(pl.col("n") >= 0))
    halves = [smooth.filter(side).drop_nulls("s") for side in (pl.col("n") < 0, pl.col("n") >= 0)]
    chart = charts.before_and_after(
        rows["n"].to_list(),
        (100 * rows["ua_share"]).to_list(),
        [(h["n"].to_list(), h["s"].to_list()) for h in halves],
        _("flights from the replacement"),
    )
    caption = html_text(
        "{pack}, replaced {day}. Dots: single flights; line: median of the last nine. 100 is the model's design value "
        "under the same conditions. The two film coefficients are not separately identifiable in cruise; the chart has "
        "the conductance of both.",
        pack=words.pack_name(work),
        day=words.day(work["done_on"]),
    )
    return _figure(title, caption, {"label": _("UA, % of design"), "si": chart})
