"""Samples and legs of a declared component at the edges of what makes a flight speak of it."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.components import components
from hdt_core.flight.component_legs import component_legs, component_samples

HXT = components()["HXT"]
START, MINUTE = datetime(2024, 3, 1, 6, tzinfo=UTC), timedelta(minutes=1)
FLOWN = {"hot_in_k": 400.0, "hot_out_k": 300.0, "tat_k": 250.0, "altitude_m": 10_000.0, "mach": 0.8, "fan_rad_s": 300.0}


def signals(rows: int = 6, code: str = "HXT", **changed: object) -> pl.DataFrame:
    """A flight's signals in the long form; a signal whose value is None is not recorded."""
    recorded = FLOWN | changed
    own = {"operator": "TST", "tail": "T", "flight_id": "F", "pack": 1, "component": code}
    lines = [
        own | {"signal": name, "value": value[k] if isinstance(value, list) else value, "time_utc": START + k * MINUTE}
        for name, value in recorded.items()
        for k in range(rows)
    ]
    frame = pl.DataFrame(lines, schema_overrides={"value": pl.Float64, "pack": pl.Int32})
    return frame.filter(pl.col("value").is_not_null())


def leg(component=HXT, **changed: object) -> dict[str, object]:
    return component_legs(component_samples(signals(**changed), component), component).row(0, named=True)


def test_a_leg_of_six_samples_speaks():
    row = leg()
    assert (row["reason"], row["component"], row["n_samples"], row["n_nominal"]) == ("", "HXT", 6, 6)
    assert row["departed_at"] == START
    wide = component_samples(pl.concat([signals(), signals(code="OTHER", mach=0.1)]), HXT)
    assert wide["mach"].to_list() == [0.8] * 6
    assert wide["ram_exit_open"].null_count() == 6


@pytest.mark.parametrize(("slow", "reason"), [(1, ""), (2, "FEW_SAMPLES")])
def test_five_nominal_samples_are_enough(slow, reason):
    row = leg(mach=[0.15] * slow + [0.151] * (6 - slow))
    assert (row["n_nominal"], row["reason"]) == (6 - slow, reason)


def test_a_channel_that_is_needed_is_missed_and_another_not():
    assert leg(hot_out_k=None)["reason"] == "NOT_RECORDED"
    assert leg(fan_rad_s=None)["reason"] == ""
    assert leg(hot_out_k=[300.0] + [None] * 5)["reason"] == "FEW_SAMPLES"
    needed = tuple(replace(c, needed=c.needed or c.signal == "fan_rad_s") for c in HXT.record.channels)
    unit = replace(HXT, record=replace(HXT.record, channels=needed))
    assert leg(unit, fan_rad_s=None)["reason"] == ""  # the model has all it takes


@pytest.mark.parametrize(("harmful", "reason"), [(0.009, "UNSTEADY"), (0.011, "")])
def test_a_signal_that_drifts_faster_than_it_may_is_unsteady(harmful, reason):
    """A kelvin every hundred seconds."""
    drifting = [replace(c, harmful_per_s=harmful) if c.signal == "tat_k" else c for c in HXT.record.channels]
    unit = replace(HXT, record=replace(HXT.record, channels=tuple(drifting)))
    tat = [250.0 + 0.6 * k + 0.001 * (k % 2) for k in range(6)]
    assert leg(unit, tat_k=tat)["reason"] == reason


def test_a_component_of_the_packs_record_has_no_samples_of_its_own():
    with pytest.raises(ValueError, match="HX has no record"):
        component_samples(signals(), components()["HX"])


def test_legs_come_in_order_of_departure():
    later = signals().with_columns(flight_id=pl.lit("A"), time_utc=pl.col("time_utc") + timedelta(hours=9))
    wide = component_samples(pl.concat([later, signals()]), HXT)
    assert component_legs(wide, HXT)["flight_id"].to_list() == ["F", "A"]
