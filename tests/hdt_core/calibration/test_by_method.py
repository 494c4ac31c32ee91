"""The pack's parts by any method: design and each flight's health lie near the default's, or are none."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from alter import alter
from strangers import NAME, Lost, Newton, forget_methods, install_method

from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm, design_parameters
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.components.pack import CC, HX, Parts
from hdt_core.records.keys import IN_ORDER
from hdt_core.tracking.track import track

METHODS = ("ekf", "ukf", "pso", "pinn", NAME)
VALUES = {"ln_ua_ratio": "ln_ua_ratio_sd", "diameter_m": "diameter_m_se", "efficiency": "efficiency_se"}
DESIGN = {"intercept_m": "intercept_sd_m", "slope_m_per_count": "slope_sd_m_per_count",
          "group_m3": "group_sd_m3", "efficiency": "efficiency_sd"}  # fmt: skip


def by(method: str) -> Parts:
    """Both parts by one method."""
    return Parts(replace(HX, estimator=method), replace(CC, estimator=method))


@pytest.fixture
def package(monkeypatch) -> Iterator[Callable[[object], None]]:
    """Have a package bring a method."""
    yield lambda method: install_method(monkeypatch, method)
    forget_methods()


@pytest.fixture
def stranger(package) -> None:
    """A package that brings `newton`."""
    package(Newton())


@pytest.fixture(scope="module")
def few(fleet) -> pl.DataFrame:
    """Samples of five flights of two packs."""
    samples = fleet.only("T-00").samples
    first = samples["flight_id"].unique().sort().head(5)
    return samples.filter(pl.col("flight_id").is_in(first.implode()))


@pytest.fixture(scope="module")
def default(few, model) -> pl.DataFrame:
    """The same flights by the default."""
    return estimate_flights(few, model).sort(IN_ORDER)


@pytest.mark.usefixtures("stranger")
@pytest.mark.parametrize("method", METHODS)
def test_flight_lies_near_default(few, model, default, method):
    flights = estimate_flights(few, model, by(method)).sort(IN_ORDER)

    for column, sd_column in VALUES.items():
        sd = np.hypot(flights[sd_column], default[sd_column])
        assert (np.abs(flights[column] - default[column]) < 3.0 * sd).all(), column


@pytest.mark.usefixtures("stranger")
def test_other_columns_stay(few, model, default):
    flights = estimate_flights(few, model, by(NAME)).sort(IN_ORDER)

    of_method = {*VALUES, *VALUES.values(), "ua_w_k", "door_apart_ln", "cc_n_samples"}
    same = sorted(set(default.columns) - of_method)
    assert flights.select(same).equals(default.select(same))


def test_nls_is_the_closed_form(few, model, default):
    assert estimate_flights(few, model, by("nls")).sort(IN_ORDER).equals(default)


@pytest.mark.parametrize(
    ("failure", "status"),
    [
        (Lost("diverged"), "diverged"),
        (Lost("not_identifiable"), "not_identifiable"),
        (Lost("converged", mean=np.nan), "diverged"),
        (Lost("converged", mean=np.inf), "diverged"),
    ],
)
def test_failed_method_states_status(few, model, package, failure, status):
    package(failure)

    flights = estimate_flights(few, model, by(NAME))

    assert flights.select("status", "cc_status").unique().rows() == [(status, status)]
    assert flights.select(*VALUES, *VALUES.values()).null_count().row(0) == (flights.height,) * 6


@pytest.mark.parametrize(
    ("parameter", "status"), [("hx_fouling", "predicted"), ("cc_effective_diameter_m", "diverged")]
)
def test_failed_flights_state_status(few, model, nothing_done, package, parameter, status):
    package(Lost("diverged"))

    health = track(estimate_flights(few, model, by(NAME)), nothing_done, model, parts=by(NAME)).health

    assert health.filter(parameter=parameter)["status"].unique().to_list() == [status]


def test_diameter_has_methods_deviation(few, model, nothing_done):
    flights = estimate_flights(few, model, by("ekf")).sort(IN_ORDER)

    rows = track(flights, nothing_done, model, parts=by("ekf")).health.filter(parameter="cc_effective_diameter_m")

    expected = np.hypot(0.0025 * flights["diameter_m"], flights["diameter_m_se"])
    np.testing.assert_allclose(rows.sort(IN_ORDER)["sd"], expected)


def test_unrecorded_diffuser_leaves_diameter(few, model):
    blind = few.with_columns(vda_counts=pl.lit(None, pl.Float64))

    flights = estimate_flights(blind, model, by("ekf"))

    usual = estimate_flights(blind, model)
    np.testing.assert_allclose(flights["diameter_m"], usual["diameter_m"], rtol=0.03)


def test_unrecorded_exit_temperature_costs_efficiency(few, model):
    flights = estimate_flights(few.with_columns(cc_out_k=pl.lit(None, pl.Float64)), model, by("ekf"))

    assert flights["efficiency"].null_count() == flights.height
    assert flights["diameter_m"].null_count() == 0


def test_spike_moves_no_estimate(few, model):
    spiked = alter(few, pl.int_range(pl.len()).over("flight_id", "pack") == 3, hx_out_k=pl.col("hx_out_k") + 25.0)

    clean, odd = (estimate_flights(rows, model, by("ekf")).sort(IN_ORDER) for rows in (few, spiked))

    np.testing.assert_allclose(odd["ln_ua_ratio"], clean["ln_ua_ratio"], atol=0.02)


@pytest.fixture(scope="module")
def two(fleet):
    """Two aircraft of the fleet."""
    return fleet.only("T-00", "T-01")


@pytest.fixture(scope="module")
def usual(two) -> Dsm:
    """Their model by the default."""
    return calibrate(two.samples, two.legs, two.maintenance)


@pytest.fixture(scope="module")
def model_by(two) -> Callable[[str], Dsm]:
    """Their model by a method."""
    return lambda method: calibrate(two.samples, two.legs, two.maintenance, (), by(method))


@pytest.mark.usefixtures("stranger")
@pytest.mark.parametrize("method", METHODS)
def test_design_lies_near_default(usual, model_by, method):
    dsm = model_by(method)

    sd = np.sqrt(np.diag(usual.exchanger_cov))
    np.testing.assert_allclose((dsm.design - usual.design) / sd, 0.0, atol=1.0)
    for value, value_sd in DESIGN.items():
        off = getattr(dsm.compressor, value) - getattr(usual.compressor, value)
        assert abs(off) < 2.0 * getattr(usual.compressor, value_sd), value


@pytest.mark.usefixtures("stranger")
def test_design_names_its_method(model_by):
    rows = design_parameters(model_by(NAME)).filter(scope="fleet")

    estimator = dict(rows.select("parameter", "estimator").rows())
    assert (estimator["hx_exponent_hot"], estimator["cc_efficiency"]) == (NAME, f"{NAME}, pooled")


def test_failed_design_is_the_default(two, usual, model_by, package):
    package(Lost("diverged"))

    dsm = model_by(NAME)

    assert dsm.exchanger == usual.exchanger
    assert (dsm.exchanger_method, dsm.compressor.method) == (f"{NAME} without an estimate, finished by nls", "nls")


@pytest.mark.usefixtures("stranger")
def test_methods_have_different_versions(usual, model_by):
    assert model_by(NAME).dsm_version != usual.dsm_version


def test_model_without_method_is_read(usual):
    stored = usual.to_dict()
    del stored["exchanger_method"], stored["compressor"]["method"]

    assert Dsm.from_dict(stored) == usual
