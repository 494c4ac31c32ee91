"""Build the report's section of the paper's figures 12, 13, 15 and 16: images with captions."""

from collections.abc import Callable
from typing import Any

import polars as pl
from markupsafe import Markup

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.plots import (
    around_replacement,
    as_svg,
    figure_12,
    figure_13,
    figure_15,
    figure_16,
    outlet_residuals,
)
from pipelines.report.templating import html_text
from pipelines.report.units import SYSTEMS, estimate, quantity
from pipelines.words import _, several

Figure = dict[str, Any]
"""Title, caption, and images by system of units: both where they differ."""


def figures(facts: Facts) -> list[Figure]:
    """Build all figures; one without data states what is missing."""
    return [f(facts) for f in (inlet_group, effective_diameter, outlet_temperature, coefficient_drift)]


def _figure(title: str, caption: Any, draw: Callable[[str], Any] | None = None, systems: Any = SYSTEMS) -> Figure:
    text = Markup(" ").join(caption) if isinstance(caption, list) else caption
    return {"title": title, "caption": text, "images": {s: as_svg(draw(s)) for s in systems} if draw else {}}


def _nominal(facts: Facts, *columns: str) -> pl.DataFrame:
    """Return admitted flights with all of `columns`."""
    return facts["twin"].filter(pl.col("admitted")).drop_nulls(list(columns))


def _count(rows: pl.DataFrame) -> Markup:
    return html_text(
        several("{n} nominal flight, one dot a flight and pack; evenly thinned where there are many.",
                "{n} nominal flights, one dot a flight and pack; evenly thinned where there are many.", rows.height)
    )  # fmt: skip


def inlet_group(facts: Facts) -> Figure:
    """Build figure 12: the identifiable group of the inlet by flight, and the fleet's by position of the diffuser."""
    title = _("Figure 12: compressor inlet, A·D·tan β against diffuser position")
    rows = _nominal(facts, "vda_counts", "group_m3")
    if not rows.height:
        return _figure(title, _("No nominal flight has compressor flow, speed and diffuser position."))
    fit = facts.dsm.compressor if facts.dsm else None
    caption = [
        _count(rows),
        html_text("Only this product of inlet area, diameter and blade angle is identifiable."),
    ]
    if fit:
        value = estimate(1e3 * fit.group_m3, 1e3 * fit.group_sd_m3, "10⁻³ m³")
        at = f"{fit.vda_counts:.0f}"
        caption.append(html_text("Line: the fleet's estimate, {value} at {counts} counts.", value=value, counts=at))
    return _figure(title, caption, lambda system: figure_12(rows, fit, system))


def effective_diameter(facts: Facts) -> Figure:
    """Build figure 13: effective diameter of the impeller and its characterisation, equation (6)."""
    title = _("Figure 13: effective compressor diameter against diffuser position")
    rows = _nominal(facts, "vda_counts", "diameter_m")
    if not rows.height:
        return _figure(title, _("No nominal flight has exit pressure, speed and diffuser position."))
    fit = facts.dsm.compressor if facts.dsm else None
    caption = [_count(rows)]
    if fit:
        at_zero = quantity(1e3 * fit.intercept_m, "mm", 1)
        by = quantity(1e5 * fit.slope_m_per_count, "mm", 3)
        line = html_text(
            "Line: equation (6) re-estimated, {at_zero} and {by} a hundred counts.", at_zero=at_zero, by=by
        )
        caption.append(line)
    return _figure(title, caption, lambda system: figure_13(rows, fit, system))


def outlet_temperature(facts: Facts) -> Figure:
    """Build figure 15: outlet temperature of one flight, sensor against twin and model, with the residual."""
    title = _("Figure 15: outlet of the heat exchanger, sensor against model")
    cruise = _samples_with_residuals(facts)
    if cruise is None:
        return _figure(title, _("No flight has five samples of steady cruise under the model in service."))
    first = cruise.row(0, named=True)
    caption = html_text(
        "Flight {flight}, pack {pack}, steady cruise ({kind}). Dots: sensor, bias not corrected. Blue: twin with this "
        "flight's conductance; orange dashes: model as built. Below: sensor minus twin, root mean square {rms}.",
        flight=first["flight_id"],
        pack=first["pack"],
        kind=_("continuous log, averaged") if (cruise["n_averaged"] > 1).any() else _("snapshots"),
        rms=quantity(float((cruise["sensor_minus_twin"] ** 2).mean()) ** 0.5, "K", 2),  # type: ignore[arg-type]
    )
    return _figure(title, caption, lambda system: figure_15(cruise, system))


def _samples_with_residuals(facts: Facts) -> pl.DataFrame | None:
    """Return cruise samples of the replacement flight with their residuals."""
    if facts.dsm is None or not facts["segment"].height:
        return None
    cruise = facts["segment"].filter(pl.col("monitored") & (pl.col("phase") == "cruise")).drop_nulls("hx_out_k")
    samples = outlet_residuals(cruise, facts["twin_flight"], facts.dsm)
    return samples if samples.height else None


def coefficient_drift(facts: Facts) -> Figure:
    """Build figure 16: conductance over the flights before and after a replacement."""
    title = _("Figure 16: conductance before and after a replacement")
    shares = facts["twin"].with_columns(ua_share=pl.col("ua_w_k") / pl.col("ua_expected_w_k")).drop_nulls("ua_share")
    replacement = around_replacement(shares, facts["maintenance"])
    if replacement is None:
        return _figure(title, _("No heat exchanger was replaced with flights on record before it."))
    work, rows = replacement
    caption = html_text(
        "{pack}, replaced {day}. Dots: single flights; line: median of the last nine. 100 is the model's design value "
        "under the same conditions. The two film coefficients are not separately identifiable in cruise; the chart has "
        "the conductance of both.",
        pack=words.pack_name(work),
        day=words.day(work["done_on"]),
    )
    return _figure(title, caption, lambda _system: figure_16(rows), SYSTEMS[:1])
