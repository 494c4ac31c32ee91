"""What a calibration shows of itself in Dagster, with a fleet and without one."""

import base64
from dataclasses import replace
from types import SimpleNamespace

import polars as pl
import pytest
from known_fleet import fleet_with_truth

from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.flight_estimates import estimate_flights
from pipelines.report import charts
from pipelines.report.figures import inlet_group
from pipelines.report.plots import calibration_metadata, figure_12, outlet_residuals


@pytest.fixture(scope="module")
def calibrated():
    fleet = fleet_with_truth(2, 40)
    dsm = calibrate(fleet.samples, fleet.legs, fleet.maintenance)
    return fleet, dsm, estimate_flights(fleet.samples, dsm)


def test_figures_are_pictures_and_tables_hold_every_form_and_unit(calibrated):
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


def test_line_of_figure_12_follows_the_diffuser(calibrated, monkeypatch):
    _, dsm, flights = calibrated
    fit = replace(dsm.compressor, group_m3=9e-4, vda_counts=400.0, group_slope_m3_per_count=5e-7)
    dsm = replace(dsm, compressor=fit)
    counts, group = figure_12(flights, dsm).axes[0].lines[-1].get_data()
    assert group == pytest.approx([0.9 + 5e-4 * (v - 400.0) for v in counts])  # 1e-3 m3
    lines = []
    monkeypatch.setattr(charts, "cloud", lambda x, y, label, line: lines.append(line))
    inlet_group(SimpleNamespace(dsm=dsm, twin=flights.with_columns(admitted=pl.lit(True))))
    counts, group = lines[0]
    assert min(counts) < flights["vda_counts"].min() < flights["vda_counts"].max() < max(counts)
    assert group == pytest.approx([0.9 + 5e-4 * (v - 400.0) for v in counts])


def test_residual_of_the_twin_is_what_its_flight_leaves_over(calibrated):
    fleet, dsm, flights = calibrated
    one = (pl.col("flight_id") == fleet.samples["flight_id"][-1]) & (pl.col("pack") == 1)
    residuals = outlet_residuals(fleet.samples.filter(one), flights.filter(one), dsm)
    assert residuals.height == fleet.samples.filter(one).height
    # a flight's own level is its median: its samples scatter about zero by the sensors' noise
    assert abs(residuals["sensor_minus_twin"].median()) < 0.3
    assert residuals["sensor_minus_twin"].std() < 1.5


def test_without_a_flight_there_is_still_something_to_show(calibrated):
    fleet, _, _ = calibrated
    none = fleet.samples.clear()
    dsm = calibrate(none, fleet.legs.clear(), fleet.maintenance)
    metadata = calibration_metadata(none, estimate_flights(none, dsm), fleet.maintenance, dsm)
    assert metadata["units_that_drift"] == 0
