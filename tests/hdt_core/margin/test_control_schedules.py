"""The controller's law is found back, whatever trims and biases lie over it."""

import json

import numpy as np
import polars as pl

from hdt_core.margin.control_schedules import TAT_KNOTS_K, ControlSchedule, ControlSchedules, learn_schedules


def test_recovers_the_schedule(fly) -> None:
    samples = fly(40, seed=3)
    law = learn_schedules(samples).outlet
    tat = np.linspace(248.0, 285.0, 30)
    truth = 0.6 * np.maximum(tat - 252.0, 0.0)
    found = law.shape("T-AAA", tat)
    np.testing.assert_allclose(found - found.mean(), truth - truth.mean(), atol=0.6)


def test_a_jammed_door_in_the_window_bends_it_little(fly) -> None:
    samples = fly(40, seed=3)
    jam = (pl.col("pack") == 2) & (pl.col("time_utc") > samples["time_utc"].quantile(0.7))
    bent = samples.with_columns(
        pl.when(jam)
        .then(pl.col("hx_out_k") + (pl.col("altitude_m") - 6000) / 600)
        .otherwise(pl.col("hx_out_k"))
        .alias("hx_out_k")
    )
    tat = np.linspace(250.0, 285.0, 20)
    sound, jammed = (
        learn_schedules(samples).outlet.shape("T-AAA", tat),
        learn_schedules(bent).outlet.shape("T-AAA", tat),
    )
    assert np.ptp(jammed - sound) < 1.5


def test_unknown_aircraft_gets_the_law_of_all() -> None:
    heights = tuple(np.arange(len(TAT_KNOTS_K), dtype=float))
    law = ControlSchedule(TAT_KNOTS_K, {"": heights}, {"": 0.0})
    assert law.shape("T-NEW", np.array([TAT_KNOTS_K[3]]))[0] == 3.0


def test_plain_form_goes_round(fly) -> None:
    laws = learn_schedules(fly(10))
    assert ControlSchedules.from_dict(json.loads(json.dumps(laws.to_dict()))) == laws


def test_too_little_data_gives_a_flat_law(fly) -> None:
    law = learn_schedules(fly(10).head(5)).outlet
    assert set(law.shapes[""]) == {0.0}


def test_recovers_duct_loss_and_cabin_schedule(fly) -> None:
    samples = fly(40, seed=4).with_columns(
        altitude_m=pl.col("altitude_m") + 300.0 * (pl.col("flight_id").rank("dense") % 5)
    )
    flow2 = pl.col("pack_flow_kg_s") ** 2
    true = (80_000.0 - 0.4 * (pl.col("altitude_m") - 10_600.0) + 19_000.0 * flow2) * (1.0 + 0.004 * pl.col("pack"))
    law = learn_schedules(samples.with_columns(cc_out_pa=true)).delivery
    low, high = (law.shape("T-AAA", np.array([10_600.0]), flow**2)[0] for flow in (0.75, 0.85))
    expected = np.log((80_000 + 19_000 * 0.85**2) / (80_000 + 19_000 * 0.75**2))
    assert abs(high - low - expected) < 0.1 * expected
