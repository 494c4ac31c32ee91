"""The model as a table: values, deviations and units by hand."""

from dataclasses import replace

import numpy as np
import pytest
from by_hand import DSM, with_bias

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.design_table import design_parameters, elasticities, flow_elasticities
from hdt_core.calibration.pooling import PooledLevel


def row(parameter: str, dsm=DSM, **where) -> dict:
    return design_parameters(dsm).filter(parameter=parameter, **where).row(0, named=True)


@pytest.mark.parametrize(
    ("parameter", "name", "shift"),
    [("hx_ua_reference_w_k", "ln_ua_reference", 0.02), ("ram_area_closed_m2", "ln_door_closed", 0.0),
     ("ram_area_open_m2", "ln_door_open", 0.0), ("ram_rest_area_m2", "ln_rest_area", 0.0)],
)  # fmt: skip
def test_a_logarithm_is_stated_as_what_it_is_of(parameter, name, shift):
    """Its deviation by its own slope; the conductance at the clean fleet's level."""
    value = np.exp(dict(zip(hx.NAMES, hx.MEAN, strict=True))[name] + shift)
    entry = row(parameter)
    assert (entry["value"], entry["sd"]) == pytest.approx((value, 0.1 * value))
    assert entry["unit"] == ("W/K at 0.9 kg/s hot, 1.6 kg/s ram" if parameter.startswith("hx") else "m2")
    assert (entry["scope"], entry["n_flights"], entry["dsm_version"]) == ("fleet", 100, "by-hand")


@pytest.mark.parametrize(("share", "identifiable"), [(0.49, True), (0.51, False)])
def test_what_halves_its_prior_is_identified(share, identifiable):
    cov = tuple(map(tuple, np.diag((share * hx.SD) ** 2)))
    rows = design_parameters(replace(DSM, exchanger_cov=cov)).filter(scope="fleet", component="HX")
    assert set(rows["identifiable"]) == {identifiable}


def test_elasticity_is_an_exponent_times_its_films_share():
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


def test_the_compressor_as_built_is_identified_within_a_tenth():
    rows = {
        r["parameter"]: r for r in design_parameters(DSM).filter(component="CC", scope="fleet").iter_rows(named=True)
    }
    want = {"cc_diameter_vda_intercept": (0.18, 0.002, "m"), "cc_diameter_vda_slope": (-2e-5, 1e-6, "m/count"),
            "cc_diameter_vda_scatter_m": (0.004, None, "m"), "cc_diameter_vda_mae_m": (0.003, None, "m"),
            "cc_diameter_vda_r_squared": (0.5, None, "-"), "cc_area_diameter_tan_beta_m3": (8e-4, 2e-5, "m3"),
            "cc_flow_group_m3_per_count": (1e-7, 2e-8, "m3/count"), "cc_efficiency": (0.8, 0.008, "-")}  # fmt: skip
    assert {n: (rows[n]["value"], rows[n]["sd"], rows[n]["unit"]) for n in want} == want
    identifiable = {n: rows[n]["identifiable"] for n in rows}
    assert not identifiable.pop("cc_flow_group_m3_per_count")
    assert {n for n, v in identifiable.items() if not v} == {
        "cc_inlet_area_m2",
        "cc_eye_diameter_m",
        "cc_blade_angle_rad",
    }
    assert rows["cc_blade_angle_rad"]["unit"] == (
        "rad, given a blade angle of 36 ± 3 degrees and a hub of 0.4 eye diameters"
    )
    edge = replace(
        DSM, compressor=replace(DSM.compressor, slope_sd_m_per_count=2.01e-6, efficiency=0.5, efficiency_sd=0.05)
    )
    assert not row("cc_diameter_vda_slope", edge)["identifiable"]
    assert not row("cc_efficiency", edge)["identifiable"]  # a tenth itself


def test_levels_and_biases_by_operator_and_pack():
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
