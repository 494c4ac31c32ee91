"""The flow a compressor can still deliver: equations (2) to (6) at its highest speed, turned round."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from hand_pack import FIT

from hdt_core.calibration.arrays import cruise_samples
from hdt_core.calibration.compressor import compressor_samples
from hdt_core.flight.control_schedules import SpeedLimit
from hdt_core.margin.compressor_demand import (
    CRITICAL_DIAMETER,
    FLOWS,
    compressor_demand,
    required_diameter,
    share_left,
)
from hdt_core.physics.air import reference_air
from hdt_core.physics.compressor import HEAD, inlet_flow_kg_s, pressure_ratio

LIMIT_RAD_S = 4500.0
CRUISE = {"flow_kg_s": 0.78, "inlet_k": 252.0, "inlet_pa": 27_500.0, "no_flow_ln": np.log(84_000.0), "flow_ln": 0.1}


def cruise_demand(**changed: float) -> pl.DataFrame:
    return pl.DataFrame({name: [value] for name, value in (CRUISE | changed).items()})


def share(ln_diameter: float = 0.0, speed_rad_s: float = LIMIT_RAD_S, **changed: float) -> float:
    shares, _ = share_left(np.array([ln_diameter]), *required_diameter(cruise_demand(**changed), FIT, speed_rad_s))
    return float(shares[0])


def test_critical_diameter_delivers_demand():
    critical, _ = required_diameter(cruise_demand(), FIT, LIMIT_RAD_S)
    speed = np.array(LIMIT_RAD_S)
    for part, ln_diameter in zip(FLOWS, critical[0], strict=True):
        # forward again: the position that lets the flow through, and the pressure the machine makes there
        flow = part * CRUISE["flow_kg_s"]
        full = inlet_flow_kg_s(np.array(1.0), np.array(CRUISE["inlet_pa"]), np.array(CRUISE["inlet_k"]), speed)
        position = FIT.position_counts(np.array(flow / full))
        np.testing.assert_allclose(FIT.group_at_m3(position) * full, flow, rtol=1e-12)
        diameter = np.exp(ln_diameter) * FIT.diameter_m(position)
        exit_pa = CRUISE["inlet_pa"] * pressure_ratio(diameter, np.array(CRUISE["inlet_k"]), speed)
        asked_pa = np.exp(CRUISE["no_flow_ln"] + CRUISE["flow_ln"] * part**2)
        np.testing.assert_allclose(exit_pa, asked_pa, rtol=1e-12)


def test_smaller_machine_delivers_less():
    left = [share(ln_diameter) for ln_diameter in (0.0, -0.03, -0.06, -0.1)]
    assert (np.diff(left) < 0.0).all()
    assert left[-1] > 0.0


def test_higher_limit_leaves_more():
    assert share(-0.05, speed_rad_s=1.02 * LIMIT_RAD_S) > share(-0.05)


@pytest.mark.parametrize(("widest", "bound"), [(1.1, 1.0), (1.0, 1.0), (0.9, 0.9)])
def test_share_ends_at_widest(widest, bound):
    """There it has no slope."""
    critical = np.array([[-2.0, -1.0, 0.0, 1.0, 2.0]])
    shares, slope = share_left(np.zeros(1), critical, np.array([widest]))
    assert shares[0] == pytest.approx(bound)
    assert np.isnan(slope[0]) == (widest <= 1.0)


def test_easy_cruise_ends_at_widest():
    critical, widest = required_diameter(cruise_demand(inlet_pa=60_000.0), FIT, LIMIT_RAD_S)
    shares, slope = share_left(np.zeros(1), critical, widest)
    assert shares[0] == widest[0]
    assert np.isnan(slope[0])


def test_wider_map_leaves_more():
    fits = FIT, replace(FIT, vda_widest_counts=900.0)
    demand = cruise_demand(inlet_pa=60_000.0)
    own, wider = (share_left(np.zeros(1), *required_diameter(demand, fit, LIMIT_RAD_S))[0][0] for fit in fits)
    assert wider > own


@pytest.mark.parametrize(
    "changed", [{"inlet_k": 262.0}, {"inlet_pa": 26_500.0}, {"no_flow_ln": np.log(88_000.0)}, {"flow_kg_s": 0.85}]
)
def test_harder_cruise_leaves_less_flow(changed):
    assert share(-0.05, **changed) < share(-0.05)


def p20(values: np.ndarray) -> float:
    return float(np.quantile(values, 0.8))


def pressure_ln(rows: pl.DataFrame, flow_kg_s: np.ndarray | float) -> np.ndarray:
    """Ln of the exit pressure asked for: 87 kPa, the schedule, .17 of the flow squared; the sensor reads .003 high."""
    altitude = rows["altitude_m"].to_numpy()
    return np.log(87e3) + np.interp(altitude, (5000.0, 15_000.0), (0.06, -0.04)) + 0.17 * flow_kg_s**2 - 0.003


def least_ln_diameter(
    inlet_k: np.ndarray, inlet_pa: np.ndarray, exit_ln: np.ndarray, flow: np.ndarray, limit_rad_s: float = LIMIT_RAD_S
) -> np.ndarray:
    """Equation (5) for the least diameter, over that of equation (6) where equations (2)-(4) put the diffuser."""
    cp_k = 287.053 * inlet_k / HEAD
    least = 2.0 / limit_rad_s * np.sqrt(((np.exp(exit_ln) / inlet_pa) ** HEAD - 1.0) * cp_k)
    group = 2.0 * flow * 287.053 * inlet_k / inlet_pa / limit_rad_s
    built = 0.175 - 2.8e-5 * (430.0 + (group - 9.4e-4) / 3.2e-7)
    return np.log(least / built)


def widest_kg_s(inlet_k: np.ndarray, inlet_pa: np.ndarray, limit_rad_s: float = LIMIT_RAD_S) -> np.ndarray:
    """Flow through the widest position on record, 420 counts from the middle."""
    return 0.5 * inlet_pa / (287.053 * inlet_k) * limit_rad_s * (9.4e-4 + 3.2e-7 * 420.0)


def test_demand_is_of_hardest_fifth(dsm, laws, flight):
    longer = pl.concat([flight] * 6).with_columns(pl.col("altitude_m") + 9.0 * pl.int_range(pl.len()))
    row = compressor_demand(longer, dsm, laws).row(0, named=True)
    rows = compressor_samples(cruise_samples(longer, monitored=False), dsm.pack_table())
    names = ("inlet_k", "inlet_pa", "cc_speed_rad_s", "vda_counts", "pack_flow_kg_s", "diameter_m")
    inlet_k, inlet_pa, speed, vda, pack_flow, diameter = (rows[c].to_numpy() for c in names)
    flow = 0.5 * inlet_pa / (287.053 * inlet_k) * speed * (9.4e-4 + 3.2e-7 * (vda - 430.0))
    own = np.log(diameter / (0.175 - 2.8e-5 * vda))
    hunting = own - np.median(own)
    assert row["cc_flow_asked_kg_s"] == pytest.approx(np.median(flow), rel=1e-5)
    assert row["cc_speed_limit_met"]
    for share, name in zip((0.6, 0.8, 1.0, 1.2, 1.5), CRITICAL_DIAMETER["p20"], strict=True):
        # the pack's flow goes with the machine's
        asked_ln = pressure_ln(rows, share * pack_flow)
        least = least_ln_diameter(inlet_k, inlet_pa, asked_ln, share * flow) - hunting
        assert row[name] == pytest.approx(p20(least), abs=1e-5), name
    widest = widest_kg_s(inlet_k, inlet_pa) / flow
    assert row["cc_widest_share_p20"] == pytest.approx(np.quantile(widest, 0.2), rel=1e-5)


@pytest.mark.parametrize("limit_rad_s", [4100.0, 4500.0])
def test_hot_high_demand_by_hand(dsm, laws, flight, limit_rad_s):
    """The compressor's inlet follows the air."""
    row = compressor_demand(flight, dsm, replace(laws, speed=SpeedLimit(limit_rad_s))).row(0, named=True)
    at = compressor_samples(cruise_samples(flight, monitored=False), dsm.pack_table()).median().row(0, named=True)
    flow = row["cc_flow_asked_kg_s"]
    air = {name: float(v[0]) for name, v in reference_air(1, 12_497.0).items()}
    warmer_k = air["tat_k"] + 15.0 * (1.0 + 0.2 * 0.84**2) - at["tat_k"]
    warmer_pa = at["inlet_pa"] * air["total_pressure_pa"] / at["total_pressure_pa"]
    inlet = np.array([at["inlet_k"] + warmer_k]), np.array([warmer_pa])
    there = pl.DataFrame({"altitude_m": [12_497.0]})
    demands = [(pressure_ln(there, s * at["pack_flow_kg_s"]), s * flow) for s in FLOWS]
    critical = [least_ln_diameter(*inlet, *one, limit_rad_s).item() for one in demands]
    assert [row[n] for n in CRITICAL_DIAMETER["hot_high"]] == pytest.approx(critical, abs=1e-5)
    assert row["cc_widest_share_hot_high"] == pytest.approx(widest_kg_s(*inlet, limit_rad_s) / flow, rel=1e-5)


def test_demand_needs_limit(dsm, laws, flight):
    assert compressor_demand(flight, dsm, replace(laws, speed=SpeedLimit())).height == 0


def test_demand_needs_cruise(dsm, laws, flight):
    assert compressor_demand(flight.with_columns(phase=pl.lit("climb")), dsm, laws).height == 0


@pytest.mark.parametrize(
    ("slope", "sd", "n_rows"), [(5.01e-8, 1e-8, 1), (4.99e-8, 1e-8, 0), (1.01e-8, 0.0, 1), (0.99e-8, 0.0, 0)]
)
def test_demand_needs_map(dsm, laws, flight, slope, sd, n_rows):
    """A slope of the group beyond five deviations."""
    fit = replace(dsm.compressor, group_slope_m3_per_count=slope, group_slope_sd_m3_per_count=sd)
    assert compressor_demand(flight, replace(dsm, compressor=fit), laws).height == n_rows


def test_missing_position_costs_its_sample(dsm, laws, flight):
    holed = flight.with_columns(vda_counts=pl.when(pl.int_range(pl.len()) > 0).then("vda_counts"))
    demand = compressor_demand(holed, dsm, laws).select(CRITICAL_DIAMETER["p20"])
    assert demand.height == 1
    assert demand.null_count().sum_horizontal().item() == 0


def test_unmet_limit_is_stated(dsm, laws, flight):
    unmet = replace(laws, speed=SpeedLimit(4500.0, at_limit=False))
    assert not compressor_demand(flight, dsm, unmet)["cc_speed_limit_met"][0]


def test_unmet_tail_has_sound_sensors(dsm, laws, flight):
    """Its level is that of all."""
    stranger = compressor_demand(flight.with_columns(tail=pl.lit("T-99")), dsm, laws)
    level = replace(laws.delivery, levels={"": np.log(86e3)})
    sound = replace(dsm, packs=(replace(dsm.packs[0], inlet_bias_k=0.0, inlet_bias_ln=0.0, exit_bias_ln=0.0),))
    same = compressor_demand(flight, sound, replace(laws, delivery=level))
    assert stranger.drop("tail").equals(same.drop("tail"))


@pytest.mark.parametrize("name", ["cc_in_pa", "cc_in_k", "vda_counts", "total_pressure_pa", "pack_flow_kg_s"])
@pytest.mark.parametrize("value", [0.0, -5000.0, 1e9])
def test_impossible_readings_cost_own_flight(dsm, laws, flight, name, value):
    other = flight.with_columns(flight_id=pl.lit("T-00_001"))
    odd = flight.with_columns(pl.lit(value).alias(name))
    demand = compressor_demand(pl.concat([odd, other]), dsm, laws)
    numbers = demand.select(pl.selectors.float())
    assert demand.filter(flight_id="T-00_001").equals(compressor_demand(other, dsm, laws))
    assert numbers.select(pl.all().is_finite().fill_null(True).all()).row(0) == (True,) * numbers.width
