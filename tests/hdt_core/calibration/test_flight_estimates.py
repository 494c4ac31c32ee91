"""What one flight alone says: truth recovered, biases separated, records of any poverty survived."""

import numpy as np
import polars as pl
import pytest
from known_fleet import fleet_with_truth

from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.tables.twin import TwinFlights, TwinHealth
from hdt_core.tracking.track import track

SIGNALS = ("hx_out_k", "hx_in_k", "pack_flow_kg_s")


def followed(fleet):
    model = calibrate(fleet.samples, fleet.legs, fleet.maintenance)
    return estimate_flights(fleet.samples, model), model


def test_ratio_follows_the_loss_whatever_the_offset(flights, fleet):
    joined = flights.join(fleet.truth, on=["tail", "flight_id", "pack"])
    offset_column = (pl.col("ln_ua_ratio") - (1.0 - pl.col("loss")).log()).alias("offset")
    offset = joined.with_columns(offset_column).group_by("tail", "pack").agg(pl.col("offset").std())
    assert offset["offset"].max() < 0.03


def test_declared_tables_are_honoured(flights, model, fleet):
    rows = flights.filter(TwinFlights.flight_id.col.str.len_chars() > 0)
    named = rows.with_columns(operator=pl.lit("TST"))
    assert TwinFlights.faults(named) == []
    assert TwinHealth.faults(track(flights, fleet.maintenance, model).health) == []


def test_each_flight_stands_alone(fleet, model, flights):
    one = flights["flight_id"][17]
    alone = estimate_flights(fleet.samples.filter(pl.col("flight_id") == one), model)
    among = flights.filter(pl.col("flight_id") == one)
    for column in ("ln_ua_ratio", "ln_ua_ratio_sd", "diameter_m", "effectiveness"):
        np.testing.assert_allclose(alone[column].to_numpy(), among[column].to_numpy(), rtol=1e-12)


def test_snapshots_and_continuous_log_are_both_used(fleet, model, flights):
    tail = fleet.samples.filter(pl.col("tail") == "T-00")
    even = pl.int_range(pl.len()).over("flight_id", "pack") % 2 == 0
    logged = tail.with_columns(source=pl.when(even).then(pl.lit("cpl")).otherwise(pl.lit("acms")))
    both = estimate_flights(logged, model)
    for source in ("cpl", "acms"):
        only = estimate_flights(logged.filter(pl.col("source") == source), model)
        assert (only["n_samples"] < both["n_samples"]).all()
        assert (only["status"] == "ok").all()
        apart = only["ln_ua_ratio"] - both["ln_ua_ratio"]
        assert apart.abs().max() < 6.0 * only["ln_ua_ratio_sd"].max()


@pytest.mark.parametrize("column", SIGNALS)
def test_a_pack_without_a_signal_has_rows_and_no_estimate(fleet, model, column):
    deaf = (pl.col("tail") == "T-01") & (pl.col("pack") == 2)
    samples = fleet.samples.with_columns(pl.when(~deaf).then(pl.col(column)).alias(column))
    twin = estimate_flights(samples, model)
    silent = twin.filter(deaf)
    assert silent.height == 120
    assert silent["status"].unique().to_list() == ["no_cruise"]
    rows = track(twin, fleet.maintenance, model).health.filter(deaf & (pl.col("parameter") == "hx_fouling"))
    assert rows["status"].unique().to_list() == ["predicted"]
    assert (rows["sd"] > 0.04).all()


def test_no_cruise_at_all(fleet, model):
    climbing = fleet.only("T-00").samples.with_columns(phase=pl.lit("climb"))
    twin = estimate_flights(climbing, model)
    assert twin["status"].unique().to_list() == ["no_cruise"]
    rows = track(twin, fleet.maintenance, model).health
    assert set(rows["status"]) == {"predicted", "not_recorded", "not_identifiable"}


@pytest.mark.parametrize(("tails", "n_flights"), [(1, 30), (1, 3), (2, 1)])
def test_small_fleets_are_estimated_with_wide_doubt(tails, n_flights):
    fleet = fleet_with_truth(tails, n_flights, seed=5)
    twin, model = followed(fleet)
    rows = track(twin, fleet.maintenance, model).health.filter(pl.col("parameter") == "hx_fouling")
    assert rows.height == 2 * tails * n_flights
    assert rows["sd"].min() > 0.015
    off = (rows.join(fleet.truth, on=["tail", "flight_id", "pack"])["value"] - 0.0).abs()
    assert off.max() < 0.2


def test_without_ram_outlet_the_scale_is_a_prior_and_the_doubt_is_larger(flights, model):
    blind = fleet_with_truth(5, 120, ram_out=False)
    twin, guess = followed(blind)
    assert twin["ln_ram_ratio"].null_count() == twin.height
    rows, metered = (
        track(f, blind.maintenance, m).health.filter(pl.col("parameter") == "hx_fouling")
        for f, m in ((twin, guess), (flights, model))
    )
    assert rows["sd"].mean() > metered["sd"].mean()
    off = rows.join(blind.truth, on=["tail", "flight_id", "pack"]).with_columns(e=pl.col("value") - pl.col("loss"))
    assert off.select((pl.col("e").abs() < 1.645 * pl.col("sd")).mean()).item() > 0.75


def test_a_wrong_door_shows_between_cruise_and_climb_and_wear_does_not(fleet, model):
    climb = (
        fleet.samples.filter(pl.col("phase") == "cruise")
        .group_by("operator", "tail", "pack", "flight_id")
        .head(6)
        .with_columns(phase=pl.lit("climb"), time_utc=pl.col("time_utc") - pl.duration(hours=3))
        # less air is asked for lower down: a smaller opening does
        .with_columns(ram_door_open=0.5 * pl.col("ram_door_open"))
    )
    both = pl.concat([fleet.samples, climb.select(fleet.samples.columns)])
    still = climb.select(fleet.samples.columns).with_columns(mach=pl.lit(0.0), total_pressure_pa=pl.lit(2e4))
    estimate_flights(pl.concat([fleet.samples, still]), model)  # no ram pressure: no word, no warning
    sound = estimate_flights(both, model)["door_apart_ln"]
    off = estimate_flights(both.with_columns(pl.col("ram_door_open") + 0.05), model)["door_apart_ln"]
    worn = estimate_flights(both.with_columns(pl.col("hx_out_k") + 3.0), model)["door_apart_ln"]
    assert sound.is_not_null().mean() > 0.9
    assert (off - sound).median() < -0.03
    assert abs((worn - sound).median()) < 0.5 * abs((off - sound).median())
