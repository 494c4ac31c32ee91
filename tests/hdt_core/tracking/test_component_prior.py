"""An exchanger known by its temperatures: readings, the prior where flights are few, spray once it is accepted."""

from datetime import UTC, date, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.components import components
from hdt_core.flight.component_legs import component_samples
from hdt_core.physics.unmetered_exchanger import UNMETERED, sprayed_hot_out_k
from hdt_core.tracking.component_readings import component_readings
from hdt_core.tracking.component_units import commission, unit_health

HXT, SPRAYED = components()["HXT"], components()["HXT"].with_terms(["water_spray"])
TRUE = {"hxt_ntu": 1.75, "hxt_exponent": 0.3, "hxt_water_spray": 0.4}
NO_WORK = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "component": pl.String,
                               "action": pl.String, "done_on": pl.Date})  # fmt: skip
SIGNALS = ["hot_in_k", "hot_out_k", "tat_k", "altitude_m", "mach"]


def flown(losses: list[float], spray: float = 0.4, sensor_k: float = 0.3) -> pl.DataFrame:
    """Climbs of one pack, a sample every ten seconds, in the long form of the store."""
    flights = []
    for k, loss in enumerate(losses):
        rng, t = np.random.default_rng(k), np.arange(0.0, 600.0, 10.0)
        start = datetime(2024, 1, 1, 8, tzinfo=UTC) + timedelta(days=k)
        signals = pl.DataFrame({
            "time_utc": [start + timedelta(seconds=s) for s in t], "altitude_m": 300.0 + 7.0 * t,
            "mach": 0.2 + 0.0006 * t, "tat_k": rng.uniform(292, 300) - 0.01 * t,
            "hot_in_k": 355.0 + 6.0 * np.sin(t / 90),
        }).with_columns(pl.lit(0.0).alias("hot_out_k"))  # fmt: skip
        derived = HXT.record.derive(signals)
        inputs = {s.name: derived[s.name].to_numpy() for s in UNMETERED.inputs}
        out = sprayed_hot_out_k(**inputs, **(TRUE | {"hxt_water_spray": spray}), hxt_loss=np.float64(loss))
        noise = {c: sensor_k * rng.standard_normal(t.size) for c in ("hot_in_k", "hot_out_k")}
        flights.append(signals.with_columns(
            pl.Series("hot_out_k", out + noise["hot_out_k"]), pl.col("hot_in_k") + noise["hot_in_k"],
            flight_id=pl.lit(f"T-1_{start:%Y%m%d}_01"),
        ))  # fmt: skip
    named = pl.concat(flights).with_columns(operator=pl.lit("AAA"), tail=pl.lit("T-1"), component=pl.lit("HXT"),
                                            pack=pl.lit(1, pl.Int32))  # fmt: skip
    keys = ["operator", "tail", "flight_id", "pack", "time_utc", "component"]
    return named.unpivot(SIGNALS, index=keys, variable_name="signal")


def run_component(signals: pl.DataFrame, component) -> tuple[pl.DataFrame, pl.DataFrame, pl.DataFrame]:
    legs, design = commission(signals, NO_WORK, component)
    samples = component_samples(signals, component)
    health = unit_health(samples, legs, design, NO_WORK, component)[1].health
    return design, health, component_readings(samples, component)


def test_few_flights_leave_the_prior_as_it_is_and_say_so():
    few = [run_component(flown([0.0] * n, spray=0.0), HXT) for n in (1, 9)]
    for design, health, _ in few:
        assert design["n_flights"].unique().to_list() == [0]
        assert not design["identifiable"].any()
        assert health["status"].unique().to_list() == ["prior_only"]
        assert health["value"].abs().max() < HXT.warn_loss
    one, nine = (health["sd"][-1] for _, health, _ in few)
    assert 0.8 * one < nine < HXT.warn_loss  # what they share does not average out


def test_an_effectiveness_above_one_is_no_news_of_the_part():
    _, health, readings = run_component(flown([0.0, 0.0]), HXT)
    status = dict(readings.filter(flight_id="T-1_20240101_01").select("parameter", "status").rows())
    assert status["hxt_effectiveness"] == status["hxt_effectiveness_fast"] == "one_or_more"
    assert health["value"].to_list() == [0.0, 0.0]
    assert health["status"].to_list() == ["prior_only"] * 2


def test_a_unit_that_the_log_calls_new_is_one_however_small_it_was_made():
    signals = flown([0.0] * 35 + [0.06] * 5)  # as made, the second unit is 6 % smaller
    work = pl.DataFrame([("AAA", "T-1", 1, "HXT", "REPLACED", date(2024, 2, 5))], NO_WORK.schema, orient="row")
    samples = component_samples(signals, SPRAYED)
    legs, design = commission(signals, work, SPRAYED)
    new, old = (
        unit_health(samples, legs, design, log, SPRAYED)[1].health.sort("departed_at")[-1] for log in (work, NO_WORK)
    )
    assert new["status"].item() == old["status"].item() == "ok"
    assert new["value"].item() < 0.025
    assert new["sd"].item() < 0.025
    assert old["value"].item() - 1.645 * old["sd"].item() < 0.06 < old["value"].item() + 1.645 * old["sd"].item()


def test_with_the_spray_accepted_design_and_loss_are_found():
    design, health, _ = run_component(flown([0.0] * 60 + [0.3] * 5), SPRAYED)
    values = dict(design.select("parameter", "value").rows())
    assert values["hxt_ntu"] == pytest.approx(TRUE["hxt_ntu"], rel=0.03)
    assert values["hxt_water_spray"] == pytest.approx(TRUE["hxt_water_spray"], abs=0.03)
    assert health["value"][:60].abs().max() < 0.05
    assert health["value"][-1] == pytest.approx(0.3, abs=0.06)
    assert set(health["status"]) == {"ok"}


def test_a_signal_that_is_not_recorded_is_said():
    signals = flown([0.0]).filter(~pl.col("signal").is_in(["mach", "altitude_m"]))
    legs, _ = commission(signals, NO_WORK, HXT)
    assert legs["reason"].to_list() == ["NOT_RECORDED"]
    readings = component_readings(component_samples(signals, HXT), HXT)
    status = dict(readings.select("parameter", "status").rows())
    assert status["hxt_effectiveness_fast"] == "not_recorded"
    assert status["hxt_effectiveness"] in {"measured", "one_or_more"}
