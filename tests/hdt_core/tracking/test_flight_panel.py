"""What the filter is handed of each flight, and the rows made of what it answers; by hand."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, log

from hdt_core.components.pack import HX
from hdt_core.tracking.loss_filter import fingerprints, loss_rows
from hdt_core.tracking.segments import FlightPanel, lay_out
from hdt_core.tracking.sensor_shifts import Corrections
from hdt_core.tracking.track import _null_invalid, exchanger_loss, track


@pytest.fixture
def twin_flights() -> pl.DataFrame:
    """Three flights of one pack and one of another."""
    ratio = {"ln_ua_ratio": [0.01, None, -0.1], "ln_ua_ratio_sd": [0.004, None, 0.003],
             "ua_expected_w_k": [2200.0, None, 1800.0], "ln_ua_ratio_map_sd": [0.01, None, 0.02]}  # fmt: skip
    return pl.concat([flights(3, **ratio), flights(1, tail="T-2", **{name: v[:1] for name, v in ratio.items()})])


@pytest.fixture
def faults() -> Corrections:
    shift = np.array([0.0, 0.0, -0.05, 0.0])
    blur = np.array([0.0, 0.0, 1e-4, 0.0])
    return Corrections(shift, blur, np.array([0, 0, 1, 0]) > 0, np.ones(4))


def build_panel(flights: pl.DataFrame, faults: Corrections, maintenance: pl.DataFrame) -> FlightPanel:
    return lay_out(flights, exchanger_loss(flights, faults, DSM).observations, maintenance, HX.code)


@pytest.fixture
def panel(twin_flights, faults) -> FlightPanel:
    """Of the flights and a log of a replacement and a wash of another component."""
    return build_panel(twin_flights, faults, log(("T-1", 1, "HX", "REPLACED", 1), ("T-1", 1, "CC", "CLEANED", 0)))


def test_panel_lays_packs_side_by_side(panel):
    assert panel.row.tolist() == [[0, 3], [1, -1], [2, -1]]
    assert panel.n_rows == 4
    assert panel.flights.tolist() == [3, 1]


def test_panel_removes_sensor_error(panel):
    observations = panel.observations
    np.testing.assert_allclose(observations.ratio, [[0.01, 0.01], [np.nan] * 2, [-0.05, np.nan]])
    # a flight's own noise, that of flights about the pack's health, and the correction's
    own = 0.004**2 + 0.015**2
    np.testing.assert_allclose(observations.variance, [[own, own], [1.0, 1.0], [0.003**2 + 0.015**2 + 1e-4, 1.0]])
    np.testing.assert_allclose(observations.exposure, [[1.1, 1.1], [1.0, 1.0], [0.9, 1.0]])


@pytest.mark.parametrize(
    ("name", "pack", "expected"),
    [
        ("log_open", 0, [0, 2, 2]),
        ("log_due", 0, [0, 0, 2]),
        ("log_kept", 0, [0, 1, 1]),
        ("log_kept", 1, [0, 0, 0]),
    ],
)
def test_panel_follows_the_log(panel, name, pack, expected):
    assert getattr(panel.observations, name)[:, pack].tolist() == expected


def test_panel_gives_single_cells(panel):
    one = panel.observations.of((np.array([2, 0]), np.array([0, 1])))
    np.testing.assert_allclose(one.ratio, [-0.05, 0.01])


@pytest.fixture
def prints(faults):
    """Fingerprints of flights by packs, with a seal and a column beside."""

    def take_prints(frame: pl.DataFrame, seal: str = "s", beside: float = 0.0) -> list[list[str]]:
        panel = build_panel(frame, faults, log())
        return fingerprints(panel, [np.full(4, beside)], frame["flight_id"].to_list(), seal, 2)

    return take_prints


def test_fingerprints_stay_with_flights(twin_flights, prints):
    here = prints(twin_flights)
    assert [len(own) for own in here] == [2, 1]
    assert here == prints(twin_flights)


def test_last_flight_leaves_fingerprints(twin_flights, prints):
    """It lies behind the last full segment."""
    worn = pl.when(pl.col("ln_ua_ratio") < 0).then(-0.2).otherwise("ln_ua_ratio")
    assert prints(twin_flights.with_columns(worn.alias("ln_ua_ratio"))) == prints(twin_flights)


@pytest.mark.parametrize(
    ("change", "beside"),
    [(pl.col("ln_ua_ratio").fill_null(0.3), 0.0), (pl.col("flight_id") + "x", 0.0), (pl.col("flight_id"), 1.0)],
    ids=["ratio", "name", "beside"],
)
def test_fingerprints_show_changed_flights(twin_flights, prints, change, beside):
    here = prints(twin_flights)
    other = prints(twin_flights.with_columns(change), beside=beside)
    assert [other[0][k] == here[0][k] for k in (0, 1)] == [True, False]


def test_fingerprints_show_another_seal(twin_flights, prints):
    assert prints(twin_flights, "t")[0][0] != prints(twin_flights)[0][0]


def test_loss_deviation_adds_all_sources(twin_flights, faults):
    """1 - exp(-0.3) +- exp(-0.3) times the root of filter, map and correction squared."""
    map_sd = np.array([0.01, 0.0, 0.02, 0.01])
    loss = exchanger_loss(twin_flights, faults, DSM)
    rows = loss_rows(twin_flights, loss, "hx_fouling", np.full(4, 0.3), np.full(4, 0.03))
    np.testing.assert_allclose(rows["value"], 1.0 - np.exp(-0.3))
    doubt = np.sqrt(0.03**2 + map_sd**2 + faults.variance)
    np.testing.assert_allclose(rows["sd"], np.exp(-0.3) * doubt)
    assert rows["status"].to_list() == ["ok", "predicted", "sensor_corrected", "ok"]


def test_track_uses_model_level(twin_flights):
    """An unworn pack of many flights at 0.05 above the clean level has an offset, and no wear to speak of."""
    others = ("hx_in_k", "hx_out_k", "ram_out_k", "tat_k", "pack_flow_kg_s", "ram_flow_kg_s", "efficiency")
    cc = {c: pl.lit(None, pl.Float64) for c in (*others, "diameter_m", "expected_diameter_m")}
    same = flights(30, ln_ua_ratio=0.07, ln_ua_ratio_sd=0.004, ua_expected_w_k=2000.0, ln_ua_ratio_map_sd=0.0)
    same = same.with_columns(cc_n_samples=pl.lit(0), cc_status=pl.lit(None, pl.String), **cc)
    sure = track(same, log(), DSM).health.filter(parameter=HX.loss)
    assert sure["value"].max() < 0.02
    higher = track(same, log(), replace(DSM, clean_level=0.12)).health.filter(parameter=HX.loss)
    assert higher["value"].min() > sure["value"].max()


def test_no_number_is_no_estimate():
    nan = float("nan")
    inf = float("inf")
    rows = pl.DataFrame({"value": [0.1, nan, 0.1, 0.1, None, 0.1], "sd": [0.0, 0.1, inf, -0.1, None, None]})
    result = _null_invalid(rows.with_columns(status=pl.lit("ok")))
    assert result["status"].to_list() == ["ok", *["no_number"] * 3, "ok", "ok"]
    assert result["value"].to_list() == [0.1, None, None, None, None, 0.1]
    assert result["sd"].to_list() == [0.0, None, None, None, None, None]
