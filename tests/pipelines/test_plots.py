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


@pytest.fixture(scope="module")
def metadata(calibrated) -> dict:
    fleet, dsm, flights = calibrated
    return calibration_metadata(fleet.samples, flights, fleet.maintenance, dsm)


@pytest.mark.parametrize("name", ["figure_12", "figure_13", "figure_15"])
def test_figures_are_pictures(metadata, name):
    head, data = metadata[name].md_str.split("base64,")
    assert head == "![figure](data:image/png;"
    assert base64.b64decode(data.rstrip(")")).startswith(b"\x89PNG")


@pytest.mark.parametrize("form", ["constant", "linear", "quadratic", "cubic"])
def test_table_holds_every_form(metadata, form):
    assert f"| {form} |" in metadata["equation_6"].md_str


def test_audit_holds_every_unit(metadata):
    assert metadata["drift_audit"].md_str.count("| T-0") == 4
    # left packs lose one and two per mille a flight, right ones nothing
    assert metadata["units_that_drift"] == 2


@pytest.fixture
def fit(calibrated):
    """A compressor whose group grows with the diffuser's counts."""
    compressor = calibrated[1].compressor
    return replace(compressor, group_m3=9e-4, vda_counts=400.0, group_slope_m3_per_count=5e-7)


def test_line_of_figure_12_follows_diffuser(calibrated, fit):
    flights = calibrated[2]
    counts, group = figure_12(flights, fit).axes[0].lines[-1].get_data()
    assert (min(counts), max(counts)) == (flights["vda_counts"].min(), flights["vda_counts"].max())
    assert group == pytest.approx([0.9 + 5e-4 * (v - 400.0) for v in counts])  # 1e-3 m3


def test_report_has_both_systems(calibrated, fit, monkeypatch):
    _, dsm, flights = calibrated
    calls = []
    monkeypatch.setattr(figures, "figure_12", lambda *of: calls.append(of) or figure_12(*of))
    twin = flights.with_columns(admitted=pl.lit(True))
    page = figures.inlet_group(Facts("", [], {"twin": twin}, {}, replace(dsm, compressor=fit), {}))
    assert [of[1:] for of in calls] == [(fit, "si"), (fit, "us")]
    assert set(page["images"]) == {"si", "us"}


def test_same_figure_has_same_bytes(calibrated):
    _, dsm, flights = calibrated
    one, other = (as_svg(figure_12(flights, dsm.compressor)) for _ in range(2))
    assert one == other


both_figures = pytest.mark.parametrize(("draw", "column"), [(figure_12, "group_m3"), (figure_13, "diameter_m")])


@both_figures
def test_dots_are_the_flights(calibrated, draw, column):
    _, dsm, flights = calibrated
    dots, line = draw(flights, dsm.compressor, "si").axes[0].lines
    assert dots.get_ydata() == pytest.approx(1e3 * flights.drop_nulls(["vda_counts", column])[column].to_numpy())
    assert len(line.get_xdata()) == 2


@both_figures
def test_figure_converts_to_us_units(calibrated, draw, column):
    _, dsm, flights = calibrated
    si, us = (draw(flights, dsm.compressor, system).axes[0] for system in ("si", "us"))
    factor = {"group_m3": 61.02374, "diameter_m": 0.03937008}[column]  # 1e-3 m3 and mm in in3 and in
    for metric, imperial in zip(si.lines, us.lines, strict=True):
        assert imperial.get_ydata() == pytest.approx(factor * metric.get_ydata())
    assert (si.get_ylabel().split()[-1], us.get_ylabel().split()[-1]) in {("m³", "in³"), ("mm", "in")}


@pytest.fixture(scope="module")
def one_samples(calibrated) -> pl.DataFrame:
    """Samples of one flight of one pack, with the twin's residuals."""
    fleet, dsm, flights = calibrated
    one = (pl.col("flight_id") == fleet.samples["flight_id"][-1]) & (pl.col("pack") == 1)
    rows = outlet_residuals(fleet.samples.filter(one), flights.filter(one), dsm)
    assert rows.height == fleet.samples.filter(one).height
    return rows


def test_residuals_scatter_about_zero(one_samples):
    """A flight's own level is its median: its samples scatter about it by the sensors' noise."""
    residuals = one_samples["sensor_minus_twin"]
    assert abs(residuals.median()) < 0.3
    assert residuals.std() < 1.5


def test_figure_15_shows_the_residuals(one_samples):
    sensor, twin, _ = (line.get_ydata() for line in figure_15(one_samples, "si").axes[0].lines)
    assert sensor == pytest.approx(one_samples["hx_out_k"].to_numpy() - 273.15)
    assert sensor - twin == pytest.approx(one_samples["sensor_minus_twin"].to_numpy())


def test_figure_15_converts_to_us_units(one_samples):
    (upper, lower), (upper_us, lower_us) = (figure_15(one_samples, system).axes for system in ("si", "us"))
    assert upper_us.lines[0].get_ydata() == pytest.approx(1.8 * upper.lines[0].get_ydata() + 32.0)
    assert lower_us.lines[-1].get_ydata() == pytest.approx(1.8 * lower.lines[-1].get_ydata())


def test_figure_15_limits_its_dots(one_samples):
    many = pl.concat([one_samples] * (1 + 2 * MOST_DOTS // one_samples.height))
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
    fleet = calibrated[0]
    none = fleet.samples.clear()
    dsm = calibrate(none, fleet.legs.clear(), fleet.maintenance)
    metadata = calibration_metadata(none, estimate_flights(none, dsm), fleet.maintenance, dsm)
    assert metadata["units_that_drift"] == 0


def test_failed_estimate_leaves_figure_15(calibrated):
    """An outlet hotter than the inlet: the model has an answer and the twin none."""
    fleet, model, _ = calibrated
    heated = fleet.samples.with_columns(hx_out_k=pl.col("hx_in_k") + 20.0)
    metadata = calibration_metadata(heated, estimate_flights(heated, model), fleet.maintenance, model)
    assert "figure_15" in metadata
