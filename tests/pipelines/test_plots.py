"""What a calibration shows of itself in Dagster, with a fleet and without one."""

import base64

import polars as pl
import pytest
from made import made_fleet

from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.flight_estimates import estimate_flights
from pipelines.report.plots import calibration_metadata, outlet_residuals


@pytest.fixture(scope="module")
def calibrated():
    fleet = made_fleet(2, 40)
    dsm = calibrate(fleet.samples, fleet.legs, fleet.maintenance)
    return fleet, dsm, estimate_flights(fleet.samples, dsm)


def test_figures_are_pictures_and_tables_hold_every_form_and_unit(calibrated):
    fleet, dsm, flights = calibrated
    found = calibration_metadata(fleet.samples, flights, fleet.maintenance, dsm)
    for name in ("figure_12", "figure_13", "figure_15"):
        head, data = found[name].md_str.split("base64,")
        assert head == "![figure](data:image/png;"
        assert base64.b64decode(data.rstrip(")")).startswith(b"\x89PNG")
    for form in ("constant", "linear", "quadratic", "cubic"):
        assert f"| {form} |" in found["equation_6"].md_str
    assert found["drift_audit"].md_str.count("| T-0") == 4
    # left packs lose one and two per mille a flight, right ones nothing
    assert found["units_that_drift"] == 2


def test_residual_of_the_twin_is_what_its_flight_leaves_over(calibrated):
    fleet, dsm, flights = calibrated
    one = (pl.col("flight_id") == fleet.samples["flight_id"][-1]) & (pl.col("pack") == 1)
    seen = outlet_residuals(fleet.samples.filter(one), flights.filter(one), dsm)
    assert seen.height == fleet.samples.filter(one).height
    # a flight's own level is its median: its samples scatter about zero by the sensors' noise
    assert abs(seen["sensor_minus_twin"].median()) < 0.3
    assert seen["sensor_minus_twin"].std() < 1.5


def test_without_a_flight_there_is_still_something_to_show(calibrated):
    fleet, _, _ = calibrated
    none = fleet.samples.clear()
    dsm = calibrate(none, fleet.legs.clear(), fleet.maintenance)
    found = calibration_metadata(none, estimate_flights(none, dsm), fleet.maintenance, dsm)
    assert found["units_that_drift"] == 0
