"""What a calibration shows of itself in Dagster, with a fleet and without one."""

import base64
import datetime as dt
from dataclasses import replace

import polars as pl
import pytest
from known_fleet import fleet_with_truth

from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.tables.raw import RawMaintenance
from pipelines.assets.calibration import calibration_metadata
from pipelines.report import figures
from pipelines.report.facts import Facts
from pipelines.report.plots import (
    MOST_DOTS,
    around_replacement,
    as_svg,
    figure_12,
    figure_13,
    figure_15,
    outlet_residuals,
)


@pytest.fixture(scope="module")
def calibrated():
    fleet = fleet_with_truth(2, 40)
    dsm = calibrate(fleet.samples, fleet.legs, fleet.maintenance)
    return fleet, dsm, estimate_flights(fleet.samples, dsm)


def test_figures_are_pictures(calibrated):
    fleet, dsm, flights = calibrated
    metadata = calibration_metadata(fleet.samples, flights, fleet.maintenance, dsm)
    for name in ("figure_12", "figure_13", "figure_15"):
        head, data = metadata[name].md_str.split("base64,")
        assert head == "![figure](data:image/png;"
        assert base64.b64decode(data.rstrip(")")).startswith(b"\x89PNG")
    for form in ("constant", "linear", "quadratic", "cubic"):
        assert f"| {form} |" in metadata["equation_6"].md_str
    assert metadata["drift_audit"].md_str.count("| T-0") == 4
    # left packs lose one and two per mille a flight, right ones nothing
    assert metadata["units_that_drift"] == 2


def test_line_of_figure_12_follows_diffuser(calibrated, monkeypatch):
    _, dsm, flights = calibrated
    fit = replace(dsm.compressor, group_m3=9e-4, vda_counts=400.0, group_slope_m3_per_count=5e-7)
    counts, group = figure_12(flights, fit).axes[0].lines[-1].get_data()
    assert (min(counts), max(counts)) == (flights["vda_counts"].min(), flights["vda_counts"].max())
    assert group == pytest.approx([0.9 + 5e-4 * (v - 400.0) for v in counts])  # 1e-3 m3
    drawn = []
    monkeypatch.setattr(figures, "figure_12", lambda *of: drawn.append(of) or figure_12(*of))
    twin = flights.with_columns(admitted=pl.lit(True))
    page = figures.inlet_group(Facts("", [], {"twin": twin}, {}, replace(dsm, compressor=fit), {}))
    assert [of[1:] for of in drawn] == [(fit, "si"), (fit, "us")]
    assert set(page["images"]) == {"si", "us"}
    assert as_svg(figure_12(flights, dsm.compressor)) == as_svg(figure_12(flights, dsm.compressor))


@pytest.mark.parametrize(("draw", "column"), [(figure_12, "group_m3"), (figure_13, "diameter_m")])
def test_dots_are_the_flights(calibrated, draw, column):
    _, dsm, flights = calibrated
    si, us = (draw(flights, dsm.compressor, system).axes[0] for system in ("si", "us"))
    dots, line = si.lines
    assert dots.get_ydata() == pytest.approx(1e3 * flights.drop_nulls(["vda_counts", column])[column].to_numpy())
    factor = {"group_m3": 61.02374, "diameter_m": 0.03937008}[column]  # 1e-3 m3 and mm in in3 and in
    for metric, imperial in zip(si.lines, us.lines, strict=True):
        assert imperial.get_ydata() == pytest.approx(factor * metric.get_ydata())
    assert len(line.get_xdata()) == 2
    assert (si.get_ylabel().split()[-1], us.get_ylabel().split()[-1]) in {("m³", "in³"), ("mm", "in")}


def test_figure_15_shows_the_residuals(calibrated):
    fleet, dsm, flights = calibrated
    one = (pl.col("flight_id") == fleet.samples["flight_id"][-1]) & (pl.col("pack") == 1)
    rows = outlet_residuals(fleet.samples.filter(one), flights.filter(one), dsm)
    assert rows.height == fleet.samples.filter(one).height
    # a flight's own level is its median: its samples scatter about zero by the sensors' noise
    assert abs(rows["sensor_minus_twin"].median()) < 0.3
    assert rows["sensor_minus_twin"].std() < 1.5
    (upper, lower), (upper_us, lower_us) = (figure_15(rows, system).axes for system in ("si", "us"))
    sensor, twin, _ = (line.get_ydata() for line in upper.lines)
    assert sensor == pytest.approx(rows["hx_out_k"].to_numpy() - 273.15)
    assert sensor - twin == pytest.approx(rows["sensor_minus_twin"].to_numpy())
    assert upper_us.lines[0].get_ydata() == pytest.approx(1.8 * sensor + 32.0)
    assert lower_us.lines[-1].get_ydata() == pytest.approx(1.8 * lower.lines[-1].get_ydata())
    many = pl.concat([rows] * (1 + 2 * MOST_DOTS // rows.height))
    assert MOST_DOTS / 2 < len(figure_15(many).axes[0].lines[0].get_ydata()) <= MOST_DOTS


def test_deepest_replaced_loss_is_drawn():
    start = dt.datetime(2024, 3, 1, 6, tzinfo=dt.UTC)
    replaced = 40
    own = {"operator": "AAA", "pack": 1}
    shares = [
        own | {"tail": f"T-{k}", "flight_id": f"T-{k}_{n}", "departed_at": start + dt.timedelta(days=n)}
        | {"ua_share": 1.0 - 0.001 * k * (n if n <= replaced else n - replaced)}
        for k in range(1, 9) for n in range(80)
    ]  # fmt: skip
    work = {"component": "HX", "action": "REPLACED", "done_on": (start + dt.timedelta(days=replaced)).date()}
    log = [own | work | {"tail": f"T-{k}"} for k in range(1, 9)]
    maintenance = RawMaintenance.conform(pl.DataFrame(log))
    replacement, rows = around_replacement(pl.DataFrame(shares).cast({"pack": pl.Int32}), maintenance)
    assert replacement["tail"] == "T-8"
    assert rows.filter(n=0)["departed_at"].item() == start + dt.timedelta(days=replaced + 1)
    assert rows["n"].to_list() == list(range(-replaced - 1, 80 - replaced - 1))


def test_no_flight_leaves_a_summary(calibrated):
    fleet, model, _ = calibrated
    none = fleet.samples.clear()
    dsm = calibrate(none, fleet.legs.clear(), fleet.maintenance)
    metadata = calibration_metadata(none, estimate_flights(none, dsm), fleet.maintenance, dsm)
    assert metadata["units_that_drift"] == 0
    # an outlet hotter than the inlet: the model has an answer and the twin none
    heated = fleet.samples.with_columns(hx_out_k=pl.col("hx_in_k") + 20.0)
    metadata = calibration_metadata(heated, estimate_flights(heated, model), fleet.maintenance, model)
    assert "figure_15" in metadata
