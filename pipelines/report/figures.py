"""The paper's figures 12, 13, 15 and 16 on this fleet's own flights."""

from typing import Any

import polars as pl

from pipelines.report import svg, words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, join, tag
from pipelines.report.plots import outlet_residuals
from pipelines.report.replacement import FLIGHTS_BEFORE, around_replacement

POINTS = 700


def figures(facts: Facts) -> Html:
    """All that the data allow; what they don't is said."""
    drawn = [f(facts) for f in (inlet_group, effective_diameter, outlet_temperature, coefficient_drift)]
    return tag("div", *drawn, class_="cards")


def _figure(title: str, chart: Html | None, says: str) -> Html:
    return tag("figure", tag("h3", title), chart, tag("figcaption", says), class_="card")


def _design(facts: Facts, parameter: str) -> dict[str, Any] | None:
    rows = facts["design"].filter(parameter=parameter, scope="fleet").to_dicts()
    return rows[0] if rows and rows[0]["value"] is not None else None


def _nominal(facts: Facts, *columns: str) -> pl.DataFrame:
    """Admitted flights with all of `columns`, evenly thinned."""
    rows = facts.twin.filter(pl.col("admitted")).drop_nulls(list(columns))
    return rows.gather_every(max(1, -(-rows.height // POINTS)))


def inlet_group(facts: Facts) -> Html:
    """Figure 12: the identifiable group of the inlet, by flight."""
    title = "Figure 12: compressor inlet, A·D·tan β against diffuser position"
    rows = _nominal(facts, "vda_counts", "group_m3")
    fit = _design(facts, "cc_area_diameter_tan_beta_m3")
    if not rows.height:
        return _figure(title, None, "No nominal flight has compressor flow, speed and diffuser position.")
    x, y = rows["vda_counts"].to_list(), (1e3 * rows["group_m3"]).to_list()
    chart = svg.Chart(svg.span(x), svg.span(y), title)
    chart.dots(list(zip(x, y, strict=True)), svg.BLUE)
    says = (
        f"{words.count(rows.height, 'nominal flight')} shown, one dot a flight and pack. "
        "Inlet area, diameter and blade angle are seen only as this product."
    )
    if fit:
        chart.line([(chart.x[0], 1e3 * fit["value"]), (chart.x[1], 1e3 * fit["value"])], svg.VERMILLION)
        says += f" Line: the fleet's estimate, {1e3 * fit['value']:.4g} ± {1e3 * (fit['sd'] or 0):.2g} litres."
    return _figure(title, chart.svg(svg.number_ticks(*chart.x), "10⁻³ m³", "diffuser actuator, counts"), says)


def effective_diameter(facts: Facts) -> Html:
    """Figure 13: effective diameter of the impeller and its characterisation, equation (6)."""
    title = "Figure 13: impeller effective diameter against diffuser position"
    rows = _nominal(facts, "vda_counts", "diameter_m")
    if not rows.height:
        return _figure(title, None, "No nominal flight has exit pressure, speed and diffuser position.")
    x, y = rows["vda_counts"].to_list(), (1e3 * rows["diameter_m"]).to_list()
    chart = svg.Chart(svg.span(x), svg.span(y), title)
    chart.dots(list(zip(x, y, strict=True)), svg.BLUE)
    says = f"{words.count(rows.height, 'nominal flight')} shown, one dot a flight and pack, by equation (5)."
    intercept, slope = _design(facts, "cc_diameter_vda_intercept"), _design(facts, "cc_diameter_vda_slope")
    if intercept and slope:
        a, b = intercept["value"], slope["value"]
        chart.line([(v, 1e3 * (a + b * v)) for v in chart.x], svg.VERMILLION)
        says += f" Line: equation (6) re-estimated, {a:.4f} m {'+' if b > 0 else '−'} {abs(b):.3g} m/count × position."
    return _figure(title, chart.svg(svg.number_ticks(*chart.x), "mm", "diffuser actuator, counts"), says)


def outlet_temperature(facts: Facts) -> Html:
    """Figure 15: outlet temperature of one flight, sensor against twin and model, with the residual."""
    title = "Figure 15: heat exchanger outlet, sensor against model"
    found = _samples_with_residuals(facts)
    if found is None:
        return _figure(title, None, "No flight has five samples of steady cruise under the model in service.")
    at = (found["time_utc"].dt.epoch("ms") / 60_000.0).to_list()
    at = [t - at[0] for t in at]
    sensor = (found["hx_out_k"] - 273.15).to_list()
    twin = (found["hx_out_k"] - 273.15 - found["sensor_minus_twin"]).to_list()
    model = (found["hx_out_k"] - 273.15 - found["sensor_minus_dsm"]).to_list()
    upper = svg.Chart(svg.span(at), svg.span([*sensor, *twin, *model]), title, height=200)
    upper.line(list(zip(at, model, strict=True)), svg.ORANGE, dash="5 2")
    upper.line(list(zip(at, twin, strict=True)), svg.BLUE)
    upper.dots(list(zip(at, sensor, strict=True)), "#000", size=3)
    rest = found["sensor_minus_twin"].to_list()
    lower = svg.Chart(upper.x, svg.span([*rest, 0.0]), "Residual, sensor minus twin", height=120)
    lower.line([(upper.x[0], 0), (upper.x[1], 0)], svg.GREY, width=1)
    lower.dots(list(zip(at, rest, strict=True)), svg.BLUE, size=3, opacity=0.9)
    marks = svg.number_ticks(*upper.x)
    first = found.row(0, named=True)
    kind = "continuous log, averaged" if (found["n_averaged"] > 1).any() else "snapshots"
    says = (
        f"Flight {first['flight_id']}, pack {first['pack']}, steady cruise ({kind}). Dots: sensor, known bias left in. "
        f"Blue: twin with this flight's conductance; orange dashes: model as built. Below: sensor minus twin, "
        f"root mean square {(found['sensor_minus_twin'] ** 2).mean() ** 0.5:.2f} K."  # type: ignore[operator]
    )
    return _figure(title, join(upper.svg(marks, "°C"), lower.svg(marks, "K", "minutes of cruise")), says)


def _samples_with_residuals(facts: Facts) -> pl.DataFrame | None:
    """Cruise samples of the chosen flight with their own residuals."""
    if facts.dsm is None or not facts.segment.height or not facts.twin_flight.height:
        return None
    cruise = facts.segment.filter(pl.col("monitored") & (pl.col("phase") == "cruise")).drop_nulls("hx_out_k")
    found = outlet_residuals(cruise, facts.twin_flight, facts.dsm)
    return found if found.height else None


def coefficient_drift(facts: Facts) -> Html:
    """Figure 16: conductance over the flights before a replacement, and after it."""
    title = "Figure 16: conductance before and after a replacement"
    shares = facts.twin.with_columns(ua_share=pl.col("ua_w_k") / pl.col("ua_expected_w_k")).drop_nulls("ua_share")
    chosen = around_replacement(shares, facts["maintenance"])
    if chosen is None:
        return _figure(title, None, "No heat exchanger was replaced with flights on record before it.")
    work, rows = chosen
    n = rows["n"].to_list()
    share = (100 * rows["ua_share"]).to_list()
    chart = svg.Chart((-FLIGHTS_BEFORE if min(n) < -150 else min(n) - 3, max(n) + 3), svg.span(share, 0.08), title)
    chart.dots(list(zip(n, share, strict=True)), svg.SKY, size=3, opacity=0.8)
    smooth = rows.with_columns(s=(100 * pl.col("ua_share")).rolling_median(9, min_samples=3).over(pl.col("n") >= 0))
    for side in (smooth.filter(pl.col("n") < 0), smooth.filter(pl.col("n") >= 0)):
        chart.line(side.drop_nulls("s").select("n", "s").rows(), svg.BLUE)
    chart.mark(0, "work", svg.GREEN, f"replaced {words.day(work['done_on'])}", "R")
    says = (
        f"{work['tail']} pack {work['pack']}, replaced {words.day(work['done_on'])}. "
        "Dots: each flight by itself; line: median of the last nine. 100 is the model's design value under the same "
        "conditions. The two film coefficients cannot be told apart in cruise, so the conductance that they make "
        "together is shown."
    )
    return _figure(
        title, chart.svg(svg.number_ticks(*chart.x), "UA, % of design", "flights from the replacement"), says
    )
