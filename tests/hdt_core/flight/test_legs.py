"""Level one: every leg judged once, by its own record, for a reason."""

import polars as pl
import pytest

from hdt_core.flight.legs import REASONS, judge_legs
from hdt_core.records.keys import LEG


@pytest.fixture(scope="module")
def one_tail(fleet):
    tail = fleet.snapshots["tail"].unique().sort()[0]
    mine = fleet.snapshots.filter(pl.col("tail") == tail)
    some = mine["flight_id"].unique().sort()[:40]
    logged = mine.filter(pl.col("source") == "cpl")["flight_id"].unique()
    return mine.filter(pl.col("flight_id").is_in(pl.concat([some, logged]).implode()))


@pytest.fixture(scope="module")
def no_log(fleet):
    return fleet.maintenance.clear(), fleet.messages.clear()


@pytest.fixture(scope="module")
def legs_and_samples(one_tail, no_log):
    return judge_legs(one_tail, *no_log)


def test_every_flight_and_pack_is_judged_once_with_a_known_reason(one_tail, legs_and_samples):
    legs, _ = legs_and_samples
    assert legs.select(LEG).sort(LEG).equals(one_tail.select(LEG).unique().sort(LEG))
    assert set(legs["reason"]) <= {"", *REASONS}
    assert (legs["admitted"] == (legs["reason"] == "")).all()


def test_nominal_samples_are_monitored_samples_of_admitted_legs(legs_and_samples):
    legs, samples = legs_and_samples
    nominal = samples.filter("nominal").join(legs.select(*LEG, "admitted"), on=LEG)
    assert nominal["monitored"].all()
    assert nominal["admitted"].all()
    assert set(nominal["phase"]) == {"cruise"}
    assert nominal.height > 100


def test_order_and_repetition_of_rows_change_nothing(one_tail, no_log, legs_and_samples):
    shuffled = pl.concat([one_tail, one_tail.head(500)]).sample(fraction=1.0, shuffle=True, seed=5)
    legs, samples = judge_legs(shuffled, *no_log)
    assert legs.equals(legs_and_samples[0])
    assert samples.height == legs_and_samples[1].height


def test_verdict_on_a_flight_does_not_depend_on_the_others(one_tail, no_log, legs_and_samples):
    flight = one_tail["flight_id"].unique().sort()[20]
    alone, _ = judge_legs(one_tail.filter(pl.col("flight_id") == flight), *no_log)
    among = legs_and_samples[0].filter(pl.col("flight_id") == flight)
    same = ["n_samples", "n_nominal", "departed_at", "reason"]
    assert alone.select(same).equals(among.select(same))


def test_log_and_messages_move_the_verdict_but_never_what_is_monitored(fleet):
    quiet = judge_legs(fleet.snapshots, fleet.maintenance.clear(), fleet.messages.clear())
    logged = judge_legs(fleet.snapshots, fleet.maintenance, fleet.messages)
    assert quiet[1]["monitored"].equals(logged[1]["monitored"])
    assert logged[0]["admitted"].sum() < quiet[0]["admitted"].sum()
    assert {"MAINTENANCE", "MESSAGE"} <= set(logged[0]["reason"])


def test_log_of_one_hertz_becomes_averaged_minutes_beside_the_snapshots(legs_and_samples):
    legs, samples = legs_and_samples
    both = legs.filter(pl.col("source") == "both")
    assert both.height > 0
    averaged = samples.filter(pl.col("source") == "cpl")
    assert averaged["n_averaged"].is_between(45, 60).all()
    assert averaged["monitored"].any()
    assert (samples.filter(pl.col("source") == "acms")["n_averaged"] == 1).all()


def _altered(rows: pl.DataFrame, pack: int, **new: pl.Expr) -> pl.DataFrame:
    mine = (pl.col("pack") == pack) & (pl.col("source") == "acms")
    return rows.with_columns(
        pl.when(mine).then(value).otherwise(pl.col(name)).alias(name) for name, value in new.items()
    )


@pytest.mark.parametrize(
    ("new", "reason"),
    [
        ({"pack_flow_kg_s": pl.lit(0.7711)}, "SENSOR_FROZEN"),
        ({"hx_out_k": pl.when(pl.int_range(pl.len()) % 3 > 0).then("hx_out_k")}, "SENSOR_MISSING"),
        ({"pack_flow_kg_s": 0.001 * pl.col("pack_flow_kg_s")}, "PACK_OFF"),
        ({"ram_door_open": 0.4 + 0.01 * (pl.col("ram_door_open") - 0.3)}, "DOOR_STILL"),
        ({"altitude_m": 1_500.0 + 0.1 * pl.col("altitude_m")}, "NO_CRUISE"),
    ],
    ids=["frozen", "dropout", "pack off", "door still", "no cruise"],
)
def test_planted_fault_is_given_its_reason(one_tail, no_log, legs_and_samples, new, reason):
    sound = legs_and_samples[0].filter(pl.col("admitted").all().over("flight_id") & (pl.col("source") == "acms"))
    flight = sound["flight_id"][10]
    sick = _altered(one_tail.filter(pl.col("flight_id") == flight), 2, **new)
    rest = one_tail.filter(pl.col("flight_id") != flight)
    legs, _ = judge_legs(pl.concat([rest, sick]), *no_log)
    mine = legs.filter((pl.col("flight_id") == flight) & (pl.col("pack") == 2))
    assert mine["reason"].to_list() == [reason]


def test_nothing_in_nothing_out(one_tail, no_log):
    legs, samples = judge_legs(one_tail.clear(), *no_log)
    assert legs.is_empty()
    assert samples.is_empty()
    assert {"admitted", "reason", "n_nominal", "cruise_minutes"} <= set(legs.columns)
