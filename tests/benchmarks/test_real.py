"""Recipes for real data, rehearsed on files of the same layout that are made here; the real ones need their folders."""

from datetime import datetime

import numpy as np
import polars as pl
import pytest

from benchmarks.real import cmapss, filters, lives, skab
from benchmarks.real.__main__ import RECIPES
from benchmarks.real.lives import life_bounds
from benchmarks.real.recipe import Score, described

RNG = np.random.default_rng


def process(rows: int, seed: int, drift: np.ndarray | float = 0.0) -> np.ndarray:
    """Six sensors that follow two causes; the third one drifts."""
    rng = RNG(seed)
    cause = rng.standard_normal((rows, 2))
    mix = RNG(1).uniform(0.5, 1.5, (2, 6))
    values = 10.0 + cause @ mix + 0.2 * rng.standard_normal((rows, 6))
    values[:, 2] += drift
    return values


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """SKAB's layout: a valve shuts from row 600 to 900."""
    folder = tmp_path_factory.mktemp("data") / "skab"
    at = pl.datetime_range(datetime(2020, 3, 1), datetime(2020, 3, 2), "1s", eager=True)[:1100]
    wrong = (np.arange(1100) >= 600) & (np.arange(1100) < 900)
    names = ["Accelerometer1RMS", "Current", "Pressure", "Temperature", "Voltage", "Volume Flow RateRMS"]
    for number, place in enumerate(("valve1/0", "valve2/0", "other/1", "other/2")):
        rows = {"datetime": at} | dict(zip(names, process(1100, number, 1.5 * wrong).T, strict=True))
        labels = {"anomaly": wrong.astype(float), "changepoint": np.zeros(1100)}
        file = folder / f"{place}.csv"
        file.parent.mkdir(parents=True, exist_ok=True)
        pl.DataFrame(rows | labels).write_csv(file, separator=";")
    return folder


def test_shut_valve_is_detected(rig):
    f1, false, missed = skab.run(rig).scores
    assert f1.value > 0.9
    assert false.value < 0.1
    assert missed.value < 0.05


def test_recipe_finds_its_folder(rig):
    assert skab.RECIPE.find_folder(rig.parent) == rig


def test_teaching_rows_are_not_scored(rig, tmp_path):
    """A fault's label among the rows that teach would be a miss that no detector can help."""
    folder = tmp_path / "skab"
    for file in skab.files(rig):
        rows = pl.read_csv(file, separator=";").with_row_index("row")
        label = pl.when(pl.col("row") < 100).then(1.0).otherwise("anomaly").alias("anomaly")
        folder.mkdir(exist_ok=True)
        name = f"{file.parent.name}_{file.name}"
        rows.with_columns(label).drop("row").write_csv(folder / name, separator=";")
    assert [score.value for score in skab.run(folder).scores] == [score.value for score in skab.run(rig).scores]


@pytest.mark.parametrize("law", [(None, 600), (None, 3000), (900.0,)])
def test_censored_life_bounds_cover(law):
    """By the law that the lives were drawn from, over 100 tables."""
    assert lives.of_law("", *law).value == pytest.approx(0.9, abs=0.01)


def test_life_table_keeps_its_end(tmp_path):
    rng = RNG(3)
    start = rng.uniform(0.0, 500.0, 4000)
    end = np.minimum(start + 400.0 * rng.weibull(2.0, 4000), 1000.0)
    file = tmp_path / "lives" / "fleet.csv"
    file.parent.mkdir()
    pl.DataFrame({"unit": range(4000), "start": start, "end": end, "event": end < 1000.0}).write_csv(file)
    assert lives.read(file)[2] is not None
    assert lives.of_table(file).value == pytest.approx(0.9, abs=0.02)  # one table: its own scatter is .007


def test_short_record_has_no_upper_bound():
    bounds = life_bounds(np.full(300, 50.0), np.zeros(300, bool), np.full(300, 50.0))
    assert (bounds.low, bounds.high) == (50.0, np.inf)


def test_challenge_penalty_is_as_published():
    """exp(-d / 13) - 1 for early, exp(d / 10) - 1 for late forecasts, summed; d is forecast less truth."""
    assert cmapss.phm_score(np.array([-13.0, 10.0, 0.0])) == pytest.approx(2.0 * (np.e - 1.0))


def test_capped_lives_are_scored_apart():
    """Two engines with 50 and 200 cycles left; the forecast ends lie between 50 and 65, and between 125 and 150."""
    by = np.stack([np.where(end <= cmapss.EDGES, 1.0, 0.0) for end in (65.0, 150.0)])
    low = np.array([40.0, 100.0])
    high = np.array([70.0, 160.0])
    forecast = cmapss.Foretold(by, low, high, (low, high))
    scores = {s.name: s.value for s in cmapss.scores("FD001", forecast, np.array([50.0, 200.0]))}
    expected = {
        "RMSE, lives capped at 125 [cycles]": np.sqrt(7.5**2 / 2),
        "RMSE, lives uncapped, forecast capped [cycles]": np.sqrt((7.5**2 + 75.0**2) / 2),
        "RMSE, lives and forecast uncapped [cycles]": np.sqrt((7.5**2 + 62.5**2) / 2),
        "95 % interval, lives capped at 125, coverage": 1.0,
        "90 % interval, lives uncapped, coverage": 0.5,
        "95 % interval, lives capped at 125, width [cycles]": (30.0 + 25.0) / 2.0,
    }
    assert {name: scores[f"FD001: {name}"] for name in expected} == pytest.approx(expected)


def test_flight_conditions_keep_turbofan_track():
    """FD002's six conditions laid over FD001's own sensors: the health track stays, for regimes are told apart."""
    folder = cmapss.Path(__file__).parents[1] / "data" / "cmapss"
    plain = cmapss.load(folder, "train_FD001")
    rng = RNG(5)
    condition = rng.integers(0, 6, plain.unit.size)
    altitude = np.array([0.0, 10.0, 20.0, 25.0, 35.0, 42.0])
    throttle = np.array([100.0, 100.0, 100.0, 60.0, 100.0, 100.0])
    settings = np.stack([altitude[condition], np.zeros(condition.size), throttle[condition]], axis=1)
    settings += 0.002 * rng.standard_normal(settings.shape)
    scale = rng.uniform(0.5, 2.0, (6, 21))
    sensors = plain.sensors * scale[condition] + 100.0 * condition[:, None]
    varied = cmapss.Engines(plain.unit, plain.cycle, settings, sensors)
    tracks = [cmapss.learn_track(engines)(engines)[0] for engines in (plain, varied)]
    assert np.corrcoef(*tracks)[0, 1] > 0.99


@pytest.mark.parametrize("names", [("RUL", "Dust_feed"), ("Dust_feed", "RUL")])
def test_swapped_filter_columns_are_corrected(tmp_path, names):
    """A life falls to 0, a dust feed does not: whichever way the names stand."""
    time = np.arange(1, 101) / 10.0
    own = {
        "Data_No": 1,
        "Differential_pressure": 5.0,
        "Flow_rate": 80.0,
        "Time": time,
        "Sampling": 10,
        "Bias_type": "a",
    }
    columns = dict(zip(names, (10.0 - time, np.full(100, 60.0)), strict=True))
    pl.DataFrame(own | columns).write_csv(tmp_path / "train.csv")
    read = filters.load(tmp_path)
    assert (read["RUL"].min(), read["Dust_feed"].min()) == (pytest.approx(0.0), 60.0)


@pytest.mark.parametrize(
    ("goal", "value", "is_met"),
    [
        ("< 16.2", 16.2, False),
        ("<= 0.1", 0.1, True),
        ("> 0.78", 0.78, False),
        (">= 0.8", 0.8, True),
        ("0.88-0.92", 0.9, True),
        ("0.88-0.92", 0.93, False),
        ("", 1.0, None),
    ],
)
def test_goal_is_met_within_bounds(goal, value, is_met):
    assert Score("", value, 0.0, 1.0, goal).is_met is is_met


@pytest.mark.parametrize("recipe", [r for r in RECIPES if r.wants], ids=lambda r: r.name)
def test_absent_data_name_their_source(tmp_path, recipe):
    assert recipe.find_folder(tmp_path) is None
    text = described(recipe, None)
    assert recipe.source in text
    assert "Not run here" in text
