"""The Digital System Model recovers how a fleet was built, doesn't learn wear, and stands still when it should."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, log, with_bias

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.baseline_wear import audit_drift
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.dsm import Dsm, design_parameters, elasticities, flow_elasticities
from hdt_core.calibration.pooling import PooledLevel
from hdt_core.estimation.panel import PanelLeastSquares
from hdt_core.flight.legs import MILESTONES, baseline_flights
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
    estimate, sd = elasticities(model)
    true = flow_elasticities(fleet.design, *model.cruise_flows_kg_s)
    assert np.abs(estimate - true).max() < 0.03
    assert (np.abs(estimate - true) < 3.0 * sd).all()
    hot, ram = model.cruise_flows_kg_s
    at = {"hx_in_k": np.full(3, 400.0), "tat_k": np.full(3, 250.0)}
    step = np.array([-1e-5, 0.0, 1e-5])
    along_hot = law(model.design, at | {"pack_flow_kg_s": hot * np.exp(step)}, np.full(3, ram))
    along_ram = law(model.design, at | {"pack_flow_kg_s": np.full(3, hot)}, ram * np.exp(step))
    slopes = [(line[2] - line[0]) / 2e-5 for line in (along_hot, along_ram)]
    np.testing.assert_allclose(flow_elasticities(model.design, hot, ram), slopes, rtol=1e-6)
    z = (model.design - fleet.design) / np.sqrt(np.diag(np.array(model.exchanger_cov)))
    assert np.abs(z).max() < 3.5
    assert (np.abs(z) < 1.645).mean() >= 0.75


def test_baseline_wear_is_not_design(fleet, flights):
    """Left packs lose up to 5 per mille a flight inside the window; their health says so, not the law."""
    joined = flights.join(fleet.truth, on=["tail", "flight_id", "pack"]).drop_nulls("ln_ua_ratio")
    within = [pl.col(c) - pl.col(c).mean().over("tail", "pack") for c in ("ln_ua_ratio",)]
    ln_ratio = (1.0 - pl.col("loss")).log()
    slope = (
        joined.filter(pl.col("pack") == 1)
        .select(y=within[0], x=ln_ratio - ln_ratio.mean().over("tail", "pack"))
        .to_numpy()
    )
    assert (slope[:, 0] @ slope[:, 1]) / (slope[:, 1] @ slope[:, 1]) == pytest.approx(1.0, abs=0.06)


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
    first = ids[: MILESTONES[2]].implode()
    some = [f.filter(pl.col("flight_id").is_in(first)) for f in (small.samples, small.legs)]
    later = ids[: MILESTONES[2] + 25].implode()
    more = [f.filter(pl.col("flight_id").is_in(later)) for f in (small.samples, small.legs)]
    early, later = (calibrate(*part, small.maintenance) for part in (some, more))
    assert later == early
    small = fleet.only("T-01")
    here = calibrate(small.samples, small.legs, small.maintenance)
    shuffled = small.samples.sample(fraction=1.0, shuffle=True, seed=4)
    assert calibrate(shuffled, small.legs, small.maintenance) == here
    warmer = small.samples.with_columns(pl.col("hx_out_k") + 1e-3)
    assert calibrate(warmer, small.legs, small.maintenance).dsm_version != here.dsm_version


def test_baseline_grows_by_milestones():
    flights = pl.DataFrame({"flight_id": [f"F{k:04d}" for k in range(400)], "departed_at": range(400)})
    named = flights.with_columns(operator=pl.lit("A"), tail=pl.lit("T"))
    lengths = [len(baseline_flights(named.head(n))) for n in (3, 12, 25, 79, 80, 159, 160, 400)]
    assert lengths == [3, 10, 20, 40, 80, 80, 160, 160]
    levels = (PooledLevel("TST", None, None, "hx_ua_reference_w_k", 1800.0, 100.0, 20),
              PooledLevel("TST", "A", 1, "hx_ua_reference_w_k", 1700.0, 170.0, 10))  # fmt: skip
    dsm = replace(with_bias(("A", 1), hx_out_k=0.7), levels=levels)
    fleet, own = row("hx_ua_reference_w_k", dsm, scope="operator"), row("hx_ua_reference_w_k", dsm, scope="tail")
    assert (fleet["component"], fleet["value"], fleet["tail"], fleet["identifiable"]) == ("HX", 1800.0, None, True)
    # a tenth itself does not identify
    assert (own["value"], own["sd"], own["pack"], own["identifiable"], own["n_flights"]) == (1700, 170, 1, False, 10)
    biases = design_parameters(dsm).filter(scope="tail", tail="A").filter(parameter="bias_hx_out_k").row(0, named=True)
    assert (biases["value"], biases["sd"], biases["unit"], biases["n_flights"]) == (0.7, 1.0, "K", 10)
    assert row("bias_pack_flow_kg_s", dsm)["unit"] == row("bias_ram_door_open", dsm)["unit"] == "-"


def test_young_tail_borrows_from_fleet(fleet):
    young = fleet.samples.filter((pl.col("tail") != "T-04") | (pl.col("flight_id") <= "T-04_20240110_01"))
    legs = fleet.legs.join(young.select(FLIGHT_PACK).unique(), on=FLIGHT_PACK, how="semi")
    dsm = calibrate(young, legs, fleet.maintenance)
    rows = design_parameters(dsm)
    assert rows.filter(tail="T-04", parameter="bias_tat_k")["n_flights"].to_list() == [10, 10]
    own = rows.filter(tail="T-04", parameter="hx_ua_reference_w_k")
    whole = rows.filter(scope="fleet", parameter="hx_ua_reference_w_k")
    # drawn towards the fleet, and hardly less sure than it: the law is shared
    assert (own["value"] / whole["value"].item() - 1.0).abs().max() < 0.08
    assert (own["sd"] < 1.6 * whole["sd"].item()).all()


def test_design_table_is_as_declared(model):
    rows = design_parameters(model)
    assert CalibrationDesign.faults(rows) == []
    assert set(rows["scope"]) == {"fleet", "operator", "tail"}
    named = rows.filter(scope="fleet")
    assert {"hx_ua_reference_w_k", "hx_exponent_hot", "hx_exponent_cold", "cc_diameter_vda_intercept",
            "cc_diameter_vda_slope", "cc_area_diameter_tan_beta_m3"} <= set(named["parameter"])  # fmt: skip
    area = named.filter(parameter="cc_inlet_area_m2").row(0, named=True)
    assert not area["identifiable"]
    assert "blade angle of 36 ± 3 degrees" in area["unit"]
    assert Dsm.from_dict(json.loads(json.dumps(model.to_dict()))) == model


def test_model_keeps_estimation_status(fleet, model, monkeypatch):
    assert model.exchanger_status == "converged"
    one_step = partial(PanelLeastSquares, max_steps=1)
    monkeypatch.setattr("hdt_core.calibration.calibrate.PanelLeastSquares", one_step)
    assert calibrate(fleet.samples, fleet.legs, fleet.maintenance).exchanger_status == "max_steps"


def test_empty_fleet_keeps_priors(fleet):
    small = fleet.only("T-00")
    dsm = calibrate(small.samples.clear(), small.legs.clear(), small.maintenance)
    np.testing.assert_allclose(dsm.design, hx.MEAN)
    assert dsm.n_flights == 0
    assert CalibrationDesign.faults(design_parameters(dsm)) == []
    small = fleet.only("T-02")
    sick = small.legs.with_columns(admitted=pl.col("pack") == 2)
    spoiled = replace(small, samples=small.samples.with_columns(
        pl.when(pl.col("pack") == 1).then(pl.col("hx_out_k") + 9.0).otherwise("hx_out_k").alias("hx_out_k")
    ))  # fmt: skip
    sound, mixed = (calibrate(f.samples, sick, f.maintenance) for f in (small, spoiled))
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


@pytest.mark.parametrize(("share", "identifiable"), [(0.49, True), (0.51, False)])
def test_halved_prior_is_identified(share, identifiable):
    cov = tuple(map(tuple, np.diag((share * hx.SD) ** 2)))
    rows = design_parameters(replace(DSM, exchanger_cov=cov)).filter(scope="fleet", component="HX")
    assert set(rows["identifiable"]) == {identifiable}


def test_elasticity_follows_film_share():
    """At 0.9 and 1.6 kg/s the film's share as declared: 0.45 each way beside a wall of 0.1; elsewhere it shifts."""
    p = dict(zip(hx.NAMES, hx.MEAN, strict=True))
    hot = (1.0 - p["hx_wall_share"]) * 0.5
    np.testing.assert_allclose(flow_elasticities(hx.MEAN, 0.9, 1.6), 0.6 * hot)
    films = hot * np.array([1.6 / 0.9, 1.2 / 1.6]) ** -0.6
    np.testing.assert_allclose(flow_elasticities(hx.MEAN, 1.6, 1.2), 0.6 * films / (films.sum() + 0.1))
    dsm = replace(DSM, cruise_flows_kg_s=(1.6, 1.2))
    at, sd = elasticities(dsm)
    slopes = np.array([
        (flow_elasticities(hx.MEAN + e, 1.6, 1.2) - flow_elasticities(hx.MEAN - e, 1.6, 1.2)) / 2e-5
        for e in 1e-5 * np.eye(len(hx.NAMES))
    ])  # fmt: skip
    np.testing.assert_allclose(sd, 0.1 * np.sqrt((slopes**2).sum(axis=0)), rtol=1e-3)
    entry = row("hx_flow_elasticity_hot", dsm)
    assert (entry["value"], entry["sd"], entry["unit"]) == (at[0], sd[0], "- at 1.60 kg/s hot, 1.20 kg/s ram")
    prior = np.sqrt(((slopes * hx.SD[:, None]) ** 2).sum(axis=0))
    for share, identifiable in ((0.49, True), (0.51, False)):
        tight = replace(dsm, exchanger_cov=tuple(map(tuple, np.diag((share * hx.SD) ** 2))))
        assert elasticities(tight)[1] == pytest.approx(share * prior, rel=1e-3)
        assert row("hx_flow_elasticity_cold", tight)["identifiable"] == identifiable


def test_compressor_is_identified_within_tenth():
    own = design_parameters(DSM).filter(component="CC", scope="fleet")
    rows = {r["parameter"]: r for r in own.iter_rows(named=True)}
    want = {"cc_diameter_vda_intercept": (0.18, 0.002, "m"), "cc_diameter_vda_slope": (-2e-5, 1e-6, "m/count"),
            "cc_diameter_vda_scatter_m": (0.004, None, "m"), "cc_diameter_vda_mae_m": (0.003, None, "m"),
            "cc_diameter_vda_r_squared": (0.5, None, "-"), "cc_area_diameter_tan_beta_m3": (8e-4, 2e-5, "m3"),
            "cc_flow_group_m3_per_count": (1e-7, 2e-8, "m3/count"), "cc_efficiency": (0.8, 0.008, "-")}  # fmt: skip
    assert {n: (rows[n]["value"], rows[n]["sd"], rows[n]["unit"]) for n in want} == want
    identifiable = {n: rows[n]["identifiable"] for n in rows}
    assert not identifiable.pop("cc_flow_group_m3_per_count")
    assert {n for n, v in identifiable.items() if not v} == {
        "cc_inlet_area_m2", "cc_eye_diameter_m", "cc_blade_angle_rad",
    }  # fmt: skip
    assert rows["cc_blade_angle_rad"]["unit"] == (
        "rad, given a blade angle of 36 ± 3 degrees and a hub of 0.4 eye diameters"
    )
    odd = {"slope_sd_m_per_count": 2.01e-6, "efficiency": 0.5, "efficiency_sd": 0.05}
    edge = replace(DSM, compressor=replace(DSM.compressor, **odd))
    assert not row("cc_diameter_vda_slope", edge)["identifiable"]
    assert not row("cc_efficiency", edge)["identifiable"]  # a tenth itself


def audit(ratio: np.ndarray, maintenance: pl.DataFrame | None = None) -> pl.DataFrame:
    rows = flights(len(ratio), ln_ua_ratio=list(map(float, ratio)))
    return audit_drift(rows, log() if maintenance is None else maintenance, DSM)


def test_audit_states_slope_of_line():
    row = audit(0.05 - 0.001 * np.arange(30)).row(0, named=True)
    assert row["drift_per_100_flights"] == pytest.approx(-0.1)
    assert row["drift_sd"] == pytest.approx(0.0, abs=1e-9)
    # medians of the first and last ten flights: 0.0455 and 0.0255; the clean fleet stands at 0.02
    assert row["anchor"] == pytest.approx(0.0455 - 0.02)
    assert row["unlearned"] == pytest.approx(0.020)
    assert row["drifts"]
    assert row["n_flights"] == 30
    ratio = np.r_[np.zeros(25), np.full(19, 0.1)]
    entry = log(("T-1", 1, "HX", "REPLACED", 24))
    assert audit(ratio, entry).select("unit", "n_flights", "drifts").rows() == [(0, 25, False)]
    assert audit(np.r_[ratio, 0.1], entry)["unit"].to_list() == [0, 1]


@pytest.mark.parametrize(("per_100", "drifts"), [(0.0099, False), (0.0101, True), (-0.0101, True)])
def test_drift_limit_is_one_percent(per_100, drifts):
    """In a hundred flights."""
    assert audit(per_100 / 100.0 * np.arange(30))["drifts"].to_list() == [drifts]


@pytest.mark.parametrize(("times", "drifts"), [(2.9, False), (3.1, True)])
def test_drift_needs_three_deviations(times, drifts):
    """Half the width of the interval that holds the slope by 68 %, which a line put on top does not widen."""
    noise = 0.02 * np.sin(2.3 * np.arange(40) ** 1.5)
    bare = audit(noise).row(0, named=True)
    slope = (np.sign(1.0) * times * bare["drift_sd"] - bare["drift_per_100_flights"]) / 100.0
    row = audit(noise + slope * np.arange(40)).row(0, named=True)
    assert row["drift_per_100_flights"] == pytest.approx(times * bare["drift_sd"])
    # of 780 slopes of pairs those a deviation of Kendall's score, sqrt(40 * 39 * 85 / 18), about the middle
    first, later = np.triu_indices(40, 1)
    slopes, half = np.sort((noise[later] - noise[first]) / (later - first)), np.sqrt(40 * 39 * 85 / 18)
    low, high = slopes[round((780 - half) / 2) - 1], slopes[round((780 + half) / 2)]
    assert bare["drift_sd"] == pytest.approx(50.0 * (high - low))
    assert row["drifts"] == drifts
