"""The Digital System Model recovers how a fleet was built, doesn't learn wear, and stands still when it should."""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import polars as pl
import pytest

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.design_table import design_parameters, elasticities, flow_elasticities
from hdt_core.calibration.drift_audit import audit_drift
from hdt_core.calibration.dsm import Dsm
from hdt_core.estimation.panel import PanelLeastSquares
from hdt_core.flight.windows import MILESTONES, baseline_flights
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s, ln_clean_conductance
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.tables.calibration import CalibrationDesign


def points_of(fleet) -> dict[str, np.ndarray]:
    rows = fleet.samples.drop_nulls(list(hx.SIGNALS)).gather_every(37)
    return {n: rows[n].to_numpy().astype(float) for n in hx.SIGNALS}


def law(design: np.ndarray, at: dict[str, np.ndarray], ram: np.ndarray) -> np.ndarray:
    return ln_clean_conductance(at, ram, design)


def test_conductance_law_is_within_two_per_cent_over_the_envelope(fleet, model):
    at = points_of(fleet)
    ram = clean_ram_flow_kg_s(at, fleet.design)
    error = law(model.design, at, ram) + model.clean_level - law(fleet.design, at, ram)
    assert np.abs(error - error.mean()).max() < 0.02
    assert abs(error.mean()) < 0.04  # five tails: biases of five probes set the level


def test_elasticities_are_within_003_and_their_intervals_hold(fleet, model):
    estimate, sd = elasticities(model)
    true = flow_elasticities(fleet.design, *model.cruise_flows_kg_s)
    assert np.abs(estimate - true).max() < 0.03
    assert (np.abs(estimate - true) < 3.0 * sd).all()


def test_elasticities_are_the_slopes_of_the_law(model):
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


def test_wear_in_the_baseline_is_not_learned_as_design(fleet, flights):
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


def test_drift_audit_names_the_packs_that_wore(fleet, model, flights):
    audit = audit_drift(flights, fleet.maintenance, model)
    worn = audit.filter(pl.col("pack") == 1).sort("tail")
    assert worn["drifts"].all()
    assert not audit.filter(pl.col("pack") == 2)["drifts"].any()
    # truth: 0.001 (tail + 1) a flight
    expected = [np.log(1.0 - 0.115 * (k + 1)) for k in range(3)]
    np.testing.assert_allclose(-worn["unlearned"].to_numpy()[:3], expected, atol=0.03)


def test_later_flights_change_nothing_once_the_window_is_full(fleet):
    small = fleet.only("T-00")
    ids = small.samples["flight_id"].unique().sort()
    first = ids[: MILESTONES[2]].implode()
    some = [f.filter(pl.col("flight_id").is_in(first)) for f in (small.samples, small.legs)]
    more = [
        f.filter(pl.col("flight_id").is_in(ids[: MILESTONES[2] + 25].implode())) for f in (small.samples, small.legs)
    ]
    early, later = (calibrate(*part, small.maintenance) for part in (some, more))
    assert later == early


def test_version_is_of_the_data_not_of_their_order(fleet):
    small = fleet.only("T-01")
    here = calibrate(small.samples, small.legs, small.maintenance)
    shuffled = small.samples.sample(fraction=1.0, shuffle=True, seed=4)
    assert calibrate(shuffled, small.legs, small.maintenance) == here
    warmer = small.samples.with_columns(pl.col("hx_out_k") + 1e-3)
    assert calibrate(warmer, small.legs, small.maintenance).dsm_version != here.dsm_version


def test_baseline_grows_by_milestones_and_ends():
    flights = pl.DataFrame({"flight_id": [f"F{k:04d}" for k in range(400)], "departed_at": range(400)})
    named = flights.with_columns(operator=pl.lit("A"), tail=pl.lit("T"))
    lengths = [len(baseline_flights(named.head(n))) for n in (3, 12, 25, 79, 80, 159, 160, 400)]
    assert lengths == [3, 10, 20, 40, 80, 80, 160, 160]


def test_tail_of_ten_flights_borrows_from_its_fleet(fleet):
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


def test_every_scope_is_there_and_the_table_honours_its_declaration(model):
    rows = design_parameters(model)
    assert CalibrationDesign.faults(rows) == []
    assert set(rows["scope"]) == {"fleet", "operator", "tail"}
    named = rows.filter(scope="fleet")
    assert {"hx_ua_reference_w_k", "hx_exponent_hot", "hx_exponent_cold", "cc_diameter_vda_intercept",
            "cc_diameter_vda_slope", "cc_area_diameter_tan_beta_m3"} <= set(named["parameter"])  # fmt: skip
    area = named.filter(parameter="cc_inlet_area_m2").row(0, named=True)
    assert not area["identifiable"]
    assert "blade angle of 36 ± 3 degrees" in area["unit"]


def test_how_the_estimate_ended_is_kept(fleet, model, monkeypatch):
    assert model.exchanger_status == "converged"
    one_step = partial(PanelLeastSquares, max_steps=1)
    monkeypatch.setattr("hdt_core.calibration.calibrate.PanelLeastSquares", one_step)
    assert calibrate(fleet.samples, fleet.legs, fleet.maintenance).exchanger_status == "max_steps"


def test_model_survives_json(model):
    assert Dsm.from_dict(json.loads(json.dumps(model.to_dict()))) == model


def test_without_a_usable_flight_the_priors_stand(fleet):
    small = fleet.only("T-00")
    dsm = calibrate(small.samples.clear(), small.legs.clear(), small.maintenance)
    np.testing.assert_allclose(dsm.design, hx.MEAN)
    assert dsm.n_flights == 0
    assert CalibrationDesign.faults(design_parameters(dsm)) == []


def test_turned_away_legs_do_not_calibrate(fleet):
    small = fleet.only("T-02")
    sick = small.legs.with_columns(admitted=pl.col("pack") == 2)
    spoiled = replace(small, samples=small.samples.with_columns(
        pl.when(pl.col("pack") == 1).then(pl.col("hx_out_k") + 9.0).otherwise("hx_out_k").alias("hx_out_k")
    ))  # fmt: skip
    sound, mixed = (calibrate(f.samples, sick, f.maintenance) for f in (small, spoiled))
    np.testing.assert_allclose(mixed.exchanger, sound.exchanger)
