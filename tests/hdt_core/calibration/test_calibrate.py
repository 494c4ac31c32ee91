"""The Digital System Model recovers how a fleet was built, doesn't learn wear, and stands still when it should."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest
from alter import alter
from by_hand import DSM, flights, log, with_bias

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.baseline_wear import audit_drift
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm, design_parameters, elasticities, flow_elasticities
from hdt_core.calibration.pooling import PooledLevel
from hdt_core.estimation.panel import PanelLeastSquares
from hdt_core.flight.legs import MILESTONES
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.tables.twin import CalibrationDesign


def points_of(fleet) -> dict[str, np.ndarray]:
    rows = fleet.samples.drop_nulls(list(hx.SIGNALS)).gather_every(37)
    return {n: rows[n].to_numpy().astype(float) for n in hx.SIGNALS}


def law(design: np.ndarray, at: dict[str, np.ndarray], ram: np.ndarray) -> np.ndarray:
    return ln_clean_conductance(at, ram, design)


def test_recovers_conductance_law(fleet, model):
    """Within two per cent over the envelope."""
    at = points_of(fleet)
    ram = clean_ram_flow_kg_s(at, fleet.design)
    error = law(model.design, at, ram) + model.clean_level - law(fleet.design, at, ram)
    assert np.abs(error - error.mean()).max() < 0.02
    assert abs(error.mean()) < 0.04  # five tails: biases of five probes set the level


def test_recovers_flow_elasticities(fleet, model):
    """To 0.03, and within their intervals."""
    estimate, sd = elasticities(model)
    error = np.abs(estimate - flow_elasticities(fleet.design, *model.cruise_flows_kg_s))
    assert error.max() < 0.03
    assert (error < 3.0 * sd).all()


def test_elasticities_are_slopes_of_law(model):
    hot, ram = model.cruise_flows_kg_s
    at = {"hx_in_k": np.full(3, 400.0), "tat_k": np.full(3, 250.0)}
    step = np.array([-1e-5, 0.0, 1e-5])
    along_hot = law(model.design, at | {"pack_flow_kg_s": hot * np.exp(step)}, np.full(3, ram))
    along_ram = law(model.design, at | {"pack_flow_kg_s": np.full(3, hot)}, ram * np.exp(step))
    slopes = [(line[2] - line[0]) / 2e-5 for line in (along_hot, along_ram)]
    np.testing.assert_allclose(flow_elasticities(model.design, hot, ram), slopes, rtol=1e-6)


def test_design_intervals_hold(fleet, model):
    z = (model.design - fleet.design) / np.sqrt(np.diag(np.array(model.exchanger_cov)))
    assert np.abs(z).max() < 3.5
    assert (np.abs(z) < 1.645).mean() >= 0.75


def test_baseline_wear_is_not_design(fleet, flights):
    """Left packs lose up to 5 per mille a flight inside the window; their health says so, not the law."""
    joined = flights.join(fleet.truth, on=["tail", "flight_id", "pack"]).drop_nulls("ln_ua_ratio").filter(pack=1)
    both = (pl.col("ln_ua_ratio"), (1.0 - pl.col("loss")).log().alias("true"))
    y, x = joined.select(v - v.mean().over("tail") for v in both).to_numpy().T
    assert (y @ x) / (x @ x) == pytest.approx(1.0, abs=0.06)


def test_drift_audit_names_worn_packs(fleet, model, flights):
    audit = audit_drift(flights, fleet.maintenance, model)
    worn = audit.filter(pl.col("pack") == 1).sort("tail")
    assert worn["drifts"].all()
    assert not audit.filter(pl.col("pack") == 2)["drifts"].any()
    # truth: 0.001 (tail + 1) a flight
    expected = [np.log(1.0 - 0.115 * (k + 1)) for k in range(3)]
    np.testing.assert_allclose(-worn["unlearned"].to_numpy()[:3], expected, atol=0.03)


def test_later_flights_change_nothing(fleet):
    small = fleet.only("T-00")
    ids = small.samples["flight_id"].unique().sort()
    windows = (pl.col("flight_id").is_in(ids[: MILESTONES[2] + n].implode()) for n in (0, 25))
    early, later = (calibrate(small.samples.filter(w), small.legs.filter(w), small.maintenance) for w in windows)
    assert later == early


@pytest.fixture(scope="module")
def small(fleet):
    """One aircraft of the fleet."""
    return fleet.only("T-01")


@pytest.fixture(scope="module")
def small_model(small) -> Dsm:
    return calibrate(small.samples, small.legs, small.maintenance)


def test_row_order_changes_nothing(small, small_model):
    shuffled = small.samples.sample(fraction=1.0, shuffle=True, seed=4)
    assert calibrate(shuffled, small.legs, small.maintenance) == small_model


def test_readings_change_version(small, small_model):
    warmer = small.samples.with_columns(pl.col("hx_out_k") + 1e-3)
    assert calibrate(warmer, small.legs, small.maintenance).dsm_version != small_model.dsm_version


LEVELS = (PooledLevel("TST", None, None, "hx_ua_reference_w_k", 1800.0, 100.0, 20),
          PooledLevel("TST", "A", 1, "hx_ua_reference_w_k", 1700.0, 170.0, 10))  # fmt: skip
LEVELLED = replace(with_bias(("A", 1), hx_out_k=0.7), levels=LEVELS)


@pytest.mark.parametrize(
    ("scope", "expected"),
    [
        ("operator", {"component": "HX", "tail": None, "value": 1800.0, "identifiable": True}),
        # a tenth itself does not identify
        ("tail", {"pack": 1, "value": 1700.0, "sd": 170.0, "identifiable": False, "n_flights": 10}),
    ],
)
def test_levels_are_stated_by_scope(scope, expected):
    stated = row("hx_ua_reference_w_k", LEVELLED, scope=scope)
    assert {name: stated[name] for name in expected} == expected


def test_biases_are_stated_by_tail():
    stated = row("bias_hx_out_k", LEVELLED, scope="tail", tail="A")
    assert [stated[name] for name in ("value", "sd", "unit", "n_flights")] == [0.7, 1.0, "K", 10]


@pytest.mark.parametrize("parameter", ["bias_pack_flow_kg_s", "bias_ram_door_open"])
def test_relative_bias_has_no_unit(parameter):
    assert row(parameter, LEVELLED)["unit"] == "-"


def test_young_tail_borrows_from_fleet(fleet):
    """Drawn towards the fleet, and hardly less sure than it: the law is shared."""
    young = fleet.samples.filter((pl.col("tail") != "T-04") | (pl.col("flight_id") <= "T-04_20240110_01"))
    legs = fleet.legs.join(young.select(FLIGHT_PACK).unique(), on=FLIGHT_PACK, how="semi")
    rows = design_parameters(calibrate(young, legs, fleet.maintenance))
    assert rows.filter(tail="T-04", parameter="bias_tat_k")["n_flights"].to_list() == [10, 10]
    own = rows.filter(tail="T-04", parameter="hx_ua_reference_w_k")
    whole = rows.filter(scope="fleet", parameter="hx_ua_reference_w_k")
    assert (own["value"] / whole["value"].item() - 1.0).abs().max() < 0.08
    assert (own["sd"] < 1.6 * whole["sd"].item()).all()


def test_design_table_is_as_declared(model):
    rows = design_parameters(model)
    named = {"hx_ua_reference_w_k", "hx_exponent_hot", "hx_exponent_cold", "cc_diameter_vda_intercept",
             "cc_diameter_vda_slope", "cc_area_diameter_tan_beta_m3"}  # fmt: skip
    assert CalibrationDesign.faults(rows) == []
    assert set(rows["scope"]) == {"fleet", "operator", "tail"}
    assert named <= set(rows.filter(scope="fleet")["parameter"])


def test_inlet_area_is_not_identified(model):
    area = row("cc_inlet_area_m2", model, scope="fleet")
    assert not area["identifiable"]
    assert "blade angle of 36 ± 3 degrees" in area["unit"]


def test_model_survives_json(model):
    assert Dsm.from_dict(json.loads(json.dumps(model.to_dict()))) == model


def test_model_keeps_estimation_status(fleet, model, monkeypatch):
    assert model.exchanger_status == "converged"
    one_step = partial(PanelLeastSquares, max_steps=1)
    monkeypatch.setattr("hdt_core.calibration.calibrate.PanelLeastSquares", one_step)
    assert calibrate(fleet.samples, fleet.legs, fleet.maintenance).exchanger_status == "max_steps"


def test_empty_fleet_keeps_priors(small):
    dsm = calibrate(small.samples.clear(), small.legs.clear(), small.maintenance)
    np.testing.assert_allclose(dsm.design, hx.MEAN)
    assert dsm.n_flights == 0
    assert CalibrationDesign.faults(design_parameters(dsm)) == []


def test_rejected_legs_do_not_calibrate(fleet):
    small = fleet.only("T-02")
    sick = small.legs.with_columns(admitted=pl.col("pack") == 2)
    spoiled = alter(small.samples, pl.col("pack") == 1, hx_out_k=pl.col("hx_out_k") + 9.0)
    sound, mixed = (calibrate(samples, sick, small.maintenance) for samples in (small.samples, spoiled))
    np.testing.assert_allclose(mixed.exchanger, sound.exchanger)


def row(parameter: str, dsm=DSM, **where) -> dict:
    return design_parameters(dsm).filter(parameter=parameter, **where).row(0, named=True)


@pytest.mark.parametrize(
    ("parameter", "name", "shift"),
    [("hx_ua_reference_w_k", "ln_ua_reference", 0.02), ("ram_area_closed_m2", "ln_door_closed", 0.0),
     ("ram_area_open_m2", "ln_door_open", 0.0), ("ram_rest_area_m2", "ln_rest_area", 0.0)],
)  # fmt: skip
def test_logarithms_are_stated_as_values(parameter, name, shift):
    """Its deviation by its own slope; the conductance at the clean fleet's level."""
    value = np.exp(dict(zip(hx.NAMES, hx.MEAN, strict=True))[name] + shift)
    entry = row(parameter)
    assert (entry["value"], entry["sd"]) == pytest.approx((value, 0.1 * value))
    assert entry["unit"] == ("W/K at 0.9 kg/s hot, 1.6 kg/s ram" if parameter.startswith("hx") else "m2")
    assert (entry["scope"], entry["n_flights"], entry["dsm_version"]) == ("fleet", 100, "by-hand")


def with_design_cov(dsm: Dsm, sd: np.ndarray) -> Dsm:
    """The model where its design has these deviations."""
    return replace(dsm, exchanger_cov=tuple(map(tuple, np.diag(sd**2))))


@pytest.mark.parametrize(("share", "identifiable"), [(0.49, True), (0.51, False)])
def test_halved_prior_is_identified(share, identifiable):
    rows = design_parameters(with_design_cov(DSM, share * hx.SD)).filter(scope="fleet", component="HX")
    assert set(rows["identifiable"]) == {identifiable}


def test_elasticity_follows_film_share():
    """At 0.9 and 1.6 kg/s the film's share as declared: 0.45 each way beside a wall of 0.1; elsewhere it shifts."""
    hot = (1.0 - dict(zip(hx.NAMES, hx.MEAN, strict=True))["hx_wall_share"]) * 0.5
    np.testing.assert_allclose(flow_elasticities(hx.MEAN, 0.9, 1.6), 0.6 * hot)
    films = hot * np.array([1.6 / 0.9, 1.2 / 1.6]) ** -0.6
    np.testing.assert_allclose(flow_elasticities(hx.MEAN, 1.6, 1.2), 0.6 * films / (films.sum() + 0.1))


BESIDE = replace(DSM, cruise_flows_kg_s=(1.6, 1.2))
"""A model of flows beside those of the law's reference."""


@pytest.fixture(scope="module")
def elasticity_slopes() -> np.ndarray:
    """Its elasticities by each value of the design."""
    return np.array([
        (flow_elasticities(hx.MEAN + e, 1.6, 1.2) - flow_elasticities(hx.MEAN - e, 1.6, 1.2)) / 2e-5
        for e in 1e-5 * np.eye(len(hx.NAMES))
    ])  # fmt: skip


def test_elasticity_is_stated_at_cruise_flows(elasticity_slopes):
    value, sd = elasticities(BESIDE)
    entry = row("hx_flow_elasticity_hot", BESIDE)
    np.testing.assert_allclose(sd, 0.1 * np.sqrt((elasticity_slopes**2).sum(axis=0)), rtol=1e-3)
    assert (entry["value"], entry["sd"], entry["unit"]) == (value[0], sd[0], "- at 1.60 kg/s hot, 1.20 kg/s ram")


@pytest.mark.parametrize(("share", "identifiable"), [(0.49, True), (0.51, False)])
def test_elasticity_is_identified_by_half(elasticity_slopes, share, identifiable):
    prior = np.sqrt(((elasticity_slopes * hx.SD[:, None]) ** 2).sum(axis=0))
    tight = with_design_cov(BESIDE, share * hx.SD)
    assert elasticities(tight)[1] == pytest.approx(share * prior, rel=1e-3)
    assert row("hx_flow_elasticity_cold", tight)["identifiable"] == identifiable


@pytest.fixture(scope="module")
def compressor_rows() -> dict[str, dict]:
    """The compressor's design parameters by name."""
    own = design_parameters(DSM).filter(component="CC", scope="fleet")
    return {r["parameter"]: r for r in own.iter_rows(named=True)}


def test_compressor_design_is_stated(compressor_rows):
    want = {"cc_diameter_vda_intercept": (0.18, 0.002, "m"), "cc_diameter_vda_slope": (-2e-5, 1e-6, "m/count"),
            "cc_diameter_vda_scatter_m": (0.004, None, "m"), "cc_diameter_vda_mae_m": (0.003, None, "m"),
            "cc_diameter_vda_r_squared": (0.5, None, "-"), "cc_area_diameter_tan_beta_m3": (8e-4, 2e-5, "m3"),
            "cc_flow_group_m3_per_count": (1e-7, 2e-8, "m3/count"), "cc_efficiency": (0.8, 0.008, "-")}  # fmt: skip
    stated = {n: tuple(compressor_rows[n][c] for c in ("value", "sd", "unit")) for n in want}
    assert stated == want


def test_blade_angle_states_its_assumption(compressor_rows):
    assumption = "rad, given a blade angle of 36 ± 3 degrees and a hub of 0.4 eye diameters"
    assert compressor_rows["cc_blade_angle_rad"]["unit"] == assumption


def test_compressor_is_identified_within_tenth(compressor_rows):
    assert {n for n, entry in compressor_rows.items() if not entry["identifiable"]} == {
        "cc_flow_group_m3_per_count", "cc_inlet_area_m2", "cc_eye_diameter_m", "cc_blade_angle_rad",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("parameter", "values"),
    [
        ("cc_diameter_vda_slope", {"slope_sd_m_per_count": 2.01e-6}),
        ("cc_efficiency", {"efficiency": 0.5, "efficiency_sd": 0.05}),  # a tenth itself
    ],
)
def test_tenth_of_value_is_not_identified(parameter, values):
    edge = replace(DSM, compressor=replace(DSM.compressor, **values))
    assert not row(parameter, edge)["identifiable"]


def audit(ratio: np.ndarray, maintenance: pl.DataFrame | None = None) -> pl.DataFrame:
    rows = flights(len(ratio), ln_ua_ratio=list(map(float, ratio)))
    return audit_drift(rows, log() if maintenance is None else maintenance, DSM)


def test_audit_states_slope_of_line():
    """Medians of the first and last ten flights: 0.0455 and 0.0255; the clean fleet stands at 0.02."""
    row = audit(0.05 - 0.001 * np.arange(30)).row(0, named=True)
    figures = {"drift_per_100_flights": -0.1, "drift_sd": 0.0, "anchor": 0.0455 - 0.02, "unlearned": 0.020}
    assert {name: row[name] for name in figures} == pytest.approx(figures, abs=1e-9)
    assert (row["drifts"], row["n_flights"]) == (True, 30)


SECOND_UNIT = log(("T-1", 1, "HX", "REPLACED", 24))
STEP = np.r_[np.zeros(25), np.full(20, 0.1)]


def test_units_are_audited_apart():
    assert audit(STEP, SECOND_UNIT)["unit"].to_list() == [0, 1]


def test_audit_needs_twenty_flights():
    rows = audit(STEP[:-1], SECOND_UNIT).select("unit", "n_flights", "drifts").rows()
    assert rows == [(0, 25, False)]


@pytest.mark.parametrize(("per_100", "drifts"), [(0.0099, False), (0.0101, True), (-0.0101, True)])
def test_drift_limit_is_one_percent(per_100, drifts):
    """In a hundred flights."""
    assert audit(per_100 / 100.0 * np.arange(30))["drifts"].to_list() == [drifts]


@pytest.mark.parametrize(("times", "drifts"), [(2.9, False), (3.1, True)])
def test_drift_needs_three_deviations(times, drifts):
    noise = 0.02 * np.sin(2.3 * np.arange(40) ** 1.5)
    bare = audit(noise).row(0, named=True)
    slope = (times * bare["drift_sd"] - bare["drift_per_100_flights"]) / 100.0
    row = audit(noise + slope * np.arange(40)).row(0, named=True)
    assert row["drift_per_100_flights"] == pytest.approx(times * bare["drift_sd"])
    assert row["drifts"] == drifts


def test_drift_deviation_is_half_interval():
    """Half the width of the interval that holds the slope by 68 %, which a line put on top does not widen: of 780
    slopes of pairs those a deviation of Kendall's score, sqrt(40 * 39 * 85 / 18), about the middle."""
    noise = 0.02 * np.sin(2.3 * np.arange(40) ** 1.5)
    first, later = np.triu_indices(40, 1)
    slopes = np.sort((noise[later] - noise[first]) / (later - first))
    half = np.sqrt(40 * 39 * 85 / 18)
    width = slopes[round((780 + half) / 2)] - slopes[round((780 - half) / 2) - 1]
    assert audit(noise)["drift_sd"][0] == pytest.approx(50.0 * width)
