"""The table to learn from: what it tells of a flight is what that night knew, and labels are told apart."""

import datetime as dt
import json

import polars as pl
import pytest
from small_catalog import catalog, flight

from benchmarks import chain
from benchmarks.fleets import read_record
from hdt_core.calibration.dsm import Dsm
from hdt_core.flight.control_schedules import ControlSchedules
from hdt_core.tables import TABLES
from pipelines.storage.catalog import connect
from pipelines.storage.store import Store

KEY = ["operator", "tail", "flight_id", "pack"]
STEPS = (chain.legs, chain.estimate, chain.follow, chain.margin, chain.features)
DAY = pl.col("flight_id").str.slice(-11, 8).str.to_date("%Y%m%d")


@pytest.fixture(scope="module")
def training_set(sample_home) -> pl.DataFrame:
    with connect(sample_home) as con:
        return con.sql("select * from training_set").pl()


@pytest.mark.parametrize("cut", [dt.date(2024, 5, 3), dt.date(2024, 6, 4)])
def test_features_know_no_later_day(sample_home, training_set, cut):
    """The leak test: without the flights, messages and work of later days every earlier row is the same."""
    store = Store(sample_home)
    record = read_record(sample_home)
    on = {"snapshots": DAY, "maintenance": pl.col("done_on"), "messages": pl.col("message_time").dt.date()}
    known_then = {name: frame.filter(on[name] < cut) for name, frame in record.items()}
    laws = json.loads(store.read_table("calibration_schedules").filter(name="controllers")["laws"].item())
    known_then |= {"dsm": Dsm.from_dict(json.loads(store.read_table("calibration_dsm")["model"].item()))}
    then = chain.run(known_then | {"laws": ControlSchedules.from_dict(laws)}, STEPS)["features"].sort(KEY)
    now = training_set.filter(cut > DAY).sort(KEY)
    assert now.height > 400
    assert now["as_stated"].sum() > 20
    names = list(TABLES["features"].schema.columns())
    for name in names:
        assert now[name].is_null().equals(then[name].is_null()), name
        far = (now[name] - then[name]).abs().max() if now[name].dtype.is_float() else None
        assert far <= 1e-9 if far is not None else now[name].equals(then[name].cast(now[name].dtype)), name


def test_calibration_precedes_rows_as_stated(sample_home, training_set):
    with connect(sample_home) as con:
        until = con.sql("select max(until_at) from tables.calibration_window").pl().item()
    assert training_set.filter("as_stated")["departed_at"].min() >= until
    assert training_set.filter(~pl.col("as_stated"))["departed_at"].max() < until


def test_labels_count_lives_down(training_set):
    labelled = training_set.filter(pl.col("label_hx_flights").is_not_null())
    own = labelled.sort(*KEY[:2], "pack", "departed_at", "flight_id")
    steps = own.select(pl.col("label_hx_flights").diff().over("split_unit")).to_series().drop_nulls()
    assert set(steps.to_list()) == {-1}
    assert own.filter("label_hx_censored")["label_hx_flights"].min() == 1


def test_lives_of_sample_end_by_message(training_set):
    events = training_set.filter(label_hx_flights=0)
    assert events.height >= 2
    assert events["label_hx_ended_by"].unique().to_list() == ["message"]
    assert not events["label_hx_censored"].any()


def test_labels_are_of_unit_that_flew():
    con = catalog(features=[flight(n) | {"pack": 1} for n in range(60)], prognosis_lives=ENDS)
    labels = con.sql("select * from training_set order by departed_at").pl()
    assert labels["label_hx_flights"].to_list() == [*range(20, -1, -1), None, *range(38, 0, -1)]
    assert labels["label_hx_censored"].to_list() == [False] * 21 + [None] + [True] * 38
    assert labels["split_unit"].unique().sort().to_list() == ["AAA/T-1/1/0", "AAA/T-1/1/1"]
    assert labels["label_cc_flights"].null_count() == 60


LIFE = {"operator": "AAA", "tail": "T-1", "pack": 1, "component": "HX", "age_known": False}
ENDS = [
    LIFE | {"life": 0, "first_row": 0, "end_row": 20, "n_flights": 20, "ended_by": "message", "censored": False},
    LIFE | {"life": 1, "first_row": 22, "end_row": 60, "n_flights": 38, "ended_by": None, "censored": True},
]


def prognosis(n: int, low: float, middle: float, high: float) -> dict:
    fields = {"pack": 1, "component": "HX", "model_version": "m", "split": "live", "p_event_50": 0.1}
    return flight(n) | fields | {"rul_low": low, "rul_flights": middle, "rul_high": high}


def test_interval_holds_end_within_it():
    """Flight 5 is 15 flights before the message, flight 25 is 35 before the last flight on record."""
    prognoses = {n: prognosis(n, 1, 5, 10) for n in range(60)} | {
        5: prognosis(5, 5, 12, 15),
        10: prognosis(10, 0, 3, 9),
        25: prognosis(25, 40, 60, 300),
        26: prognosis(26, 10, 20, 30),
    }
    con = catalog(prognoses=list(prognoses.values()), prognosis_lives=ENDS)
    names = "interval_held, outlived_low, outlived_high, event_50, outcome"
    outcomes = {r[0]: r[1:] for r in con.sql(f"select flight_id, {names} from prognosis_outcomes").fetchall()}
    assert {n: outcomes.get(flight(n)["flight_id"]) for n in (5, 10, 20, 25, 26)} == {
        5: (True, True, False, True, "event"),
        10: (False, True, True, True, "event"),
        20: None,
        25: (None, None, None, None, "open"),
        26: (None, True, True, None, "open"),
    }
