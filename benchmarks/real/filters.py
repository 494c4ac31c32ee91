"""Air filters clogged to failure: 35 whole lives to 600 Pa under dust feeds that change; one dust kind is left out.

The filter is a declared component: pressure drop over the medium and over what lies on it. The twin says second by
second how much lies there; the law of the cake (Ruth: resistance rises in proportion to the deposit) says how much more
dust it takes, and the feed how long that lasts.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from benchmarks.real.lifetimes import Foretold, Rows, coverage, foretell, history_features
from benchmarks.real.recipe import Array, Flags, Index, Recipe, Result, Score, scored
from hdt_core.calibration.component_fit import calibrate_component, flight_by_flight
from hdt_core.components import Component, Limit
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.prognosis.hazard import EDGES, quantile
from hdt_core.prognosis.metrics import constant_interval_score, interval_score
from hdt_core.tracking.component import DesignOffset, track_component

FAILS_PA = 600.0
SECOND = 10
"""Samples a second."""
SETTLED_S = 5.0
"""The fan has run up by then."""
CLEAN_S = 15.0
"""And nothing has clogged yet by then."""
NEW_SD = 0.01
"""Load of a filter taken for new."""
NO_LOG = pl.DataFrame(schema=dict.fromkeys(("operator", "tail", "component", "action"), pl.String)
                      | {"pack": pl.Int32, "done_on": pl.Date})  # fmt: skip
LOAD_PA_S_L = 9.0
"""Resistance of a load of one."""


def pressure_drop_pa(*, flow_l_s, fl_clean_pa_s_l, fl_load):
    """Of laminar flow through the medium and through what lies on it (Darcy; Ruth's law of the cake). [Pa]"""
    return (fl_clean_pa_s_l + LOAD_PA_S_L * fl_load) * flow_l_s


FILTER = Component(
    code="FL",
    name="air filter",
    lost="Clogged",
    model=PhysicsModel(
        name="air_filter",
        inputs=(Signal("flow_l_s", "l/s"),),
        outputs=(Signal("pressure_pa", "Pa", sigma=8.0),),
        params=(
            Param("fl_clean_pa_s_l", "Pa s/l", 0.15, (0.0, 2.0), "design"),
            Param("fl_load", "-", 0.0, (-0.3, 1.5), "health", drift=0.02),
        ),
        equations=pressure_drop_pa,
    ),
    loss="fl_load",
    limit=Limit(0.8, 0.02, 0.02),
    life_flights=120.0,
    action="Change the filter",
)
LIMIT = FILTER.limit.mean
"""600 Pa at the rig's 83 l/s."""


@dataclass(frozen=True, slots=True)
class Lives:
    """A row a second of each life."""

    life: Index
    second: Index
    kind: Index
    left: Array
    pressure: Array
    flow: Array
    feed: Array
    """Dust feed now. [mm3/s]"""
    dust_fed: Array
    """Dust that came so far. [mm3]"""
    load: Array
    """What the twin says. [-]"""

    def of(self, which: Flags) -> "Lives":
        """Some of the rows."""
        return Lives(*(getattr(self, f.name)[which] for f in fields(self)))


def load(folder: Path) -> pl.DataFrame:
    """Whole lives. In `train.csv` the names of remaining life and dust feed are swapped: a life falls to 0."""
    rows = pl.read_csv(folder / "train.csv")
    ends = rows.group_by("Data_No").agg(pl.col("Dust_feed", "RUL").last())
    if ends["Dust_feed"].max() < ends["RUL"].min():
        rows = rows.rename({"RUL": "Dust_feed", "Dust_feed": "RUL"})
    return rows.filter(pl.col("RUL") >= 0.0)


def samples(rows: pl.DataFrame) -> pl.DataFrame:
    """A life is an aircraft, a second of it a flight."""
    second = ((pl.col("Time") - 0.05) // 1.0).cast(pl.Int64)
    began = pl.datetime(2020, 1, 1, time_zone="UTC")
    return rows.filter(pl.col("Time") >= SETTLED_S).select(
        pl.lit("RIG").alias("operator"),
        pl.format("F{}", pl.col("Data_No").cast(pl.String).str.zfill(2)).alias("tail"),
        pl.lit(1, pl.Int32).alias("pack"),
        pl.format("S{}", second.cast(pl.String).str.zfill(4)).alias("flight_id"),
        (began + pl.duration(milliseconds=(pl.col("Time") * 1000).round().cast(pl.Int64))).alias("time_utc"),
        second.alias("second"),
        pl.col("Flow_rate").alias("flow_l_s"),
        pl.col("Differential_pressure").alias("pressure_pa"),
        pl.col("Dust_feed").alias("feed"),
        (pl.col("Dust_feed").cum_sum().over("Data_No") / SECOND).alias("dust_fed"),
        pl.col("RUL").alias("left"),
        pl.col("Bias_type").alias("kind"),
    )


def loads(samples_of_lives: pl.DataFrame) -> pl.DataFrame:
    """The twin: each filter calibrated on its first clean seconds, then tracked."""
    tracks = []
    for tail in samples_of_lives["tail"].unique(maintain_order=True):
        own = samples_of_lives.filter(tail=tail)
        dsm, _ = calibrate_component(FILTER.model, own.filter(pl.col("second") < CLEAN_S))
        flights = flight_by_flight(own, dsm, [FILTER.loss])
        tracks.append(track_component(flights, replace(FILTER, model=dsm), NO_LOG, DesignOffset(sd=NEW_SD)))
    return pl.concat(tracks).select("tail", "flight_id", load="value")


def lives(folder: Path) -> Lives:
    """Every life, second by second."""
    readings = samples(load(folder))
    by = readings.group_by("tail", "flight_id", maintain_order=True).agg(
        pl.col("second", "kind").first(),
        pl.col("left", "feed", "dust_fed").last(),
        pl.col("pressure_pa", "flow_l_s").mean(),
    )
    rows = by.join(loads(readings), on=["tail", "flight_id"], how="inner").sort("tail", "second")
    rows = rows.with_columns(pl.col("load").forward_fill().over("tail"), pl.col("tail", "kind").rank("dense"))
    life, kind = (rows[c].cast(pl.Int64).to_numpy() - 1 for c in ("tail", "kind"))
    columns = (rows[c].to_numpy() for c in ("left", "pressure_pa", "flow_l_s", "feed", "dust_fed", "load"))
    return Lives(life, rows["second"].to_numpy() - int(SETTLED_S), kind, *columns)


def dust_left(teach: Lives) -> tuple[Array, Array]:
    """Loads, and the dust that filters of that load still took: the middle of those that teach."""
    grid = np.linspace(0.0, LIMIT, 41)
    curves = []
    for life in np.unique(teach.life):
        own = teach.life == life
        risen = np.maximum.accumulate(teach.load[own])
        curves.append(teach.dust_fed[own][-1] - np.interp(grid, risen, teach.dust_fed[own]))
    return grid, np.median(curves, axis=0)


def with_physics(rows: Lives, law: tuple[Array, Array]) -> Array:
    """The layer's features of the twin's load; dust that the cake still takes, by the law and by its own slope."""
    own_slope = slope_over(rows, rows.load, rows.dust_fed, 20)
    by_law = np.interp(rows.load, *law)
    by_itself = np.clip((LIMIT - rows.load) / np.maximum(own_slope, 2e-5), 0.0, 2e4)
    by_dose = law[1][0] - rows.dust_fed
    features = [rows.load, rows.dust_fed, rows.feed, by_law, by_dose]
    features += [dust / rows.feed for dust in (by_law, by_itself, by_dose)]
    return np.column_stack([history_features(rows.load, rows.life, rows.second, LIMIT), *features, time_of_feed(rows)])


def without_physics(rows: Lives) -> Array:
    """The same features of the pressure itself, and what was recorded."""
    track = rows.pressure / FAILS_PA * LIMIT
    columns = (rows.pressure, rows.flow, rows.feed, rows.second)
    return np.column_stack([history_features(track, rows.life, rows.second, LIMIT), *columns, time_of_feed(rows)])


def time_of_feed(rows: Lives) -> Array:
    """Seconds since the feed last changed."""
    changed = (np.diff(rows.feed, prepend=rows.feed[0]) != 0.0) | (np.diff(rows.life, prepend=-1) != 0)
    at = np.maximum.accumulate(np.where(changed, np.arange(rows.feed.size), 0))
    return np.asarray(np.arange(rows.feed.size) - at, dtype=float)


def slope_over(rows: Lives, y: Array, x: Array, seconds: int) -> Array:
    """Rise of y over that of x in the last seconds of a life; 0 before."""
    back = np.maximum(np.arange(y.size) - seconds, 0)
    same = rows.life[back] == rows.life
    return np.where(same, (y - y[back]) / np.maximum(x - x[back], 1.0), 0.0)


def leave_kind_out(rows: Lives) -> tuple[Foretold, Foretold]:
    """Each dust kind foretold by filters of the other kinds: with physics, and without."""
    predictions = []
    for physics in (True, False):
        by = np.empty((rows.left.size, EDGES.size))
        bounds = np.empty((4, rows.left.size))
        for kind in np.unique(rows.kind):
            inside = rows.kind == kind
            teach = rows.of(~inside)
            law = dust_left(teach)
            x = with_physics(rows, law) if physics else without_physics(rows)
            prediction = foretell(Rows(x[~inside], teach.left, teach.life, teach.kind), x[inside])
            by[inside], bounds[:, inside] = prediction.by, (prediction.low, prediction.high, *prediction.wide)
        predictions.append(Foretold(by, bounds[0], bounds[1], (bounds[2], bounds[3])))
    return predictions[0], predictions[1]


def run(folder: Path) -> Result:
    """Whole lives, from five seconds after the start to the end."""
    rows = lives(folder)
    ours, bare = leave_kind_out(rows)

    def over_constant(prediction: Foretold) -> Callable[[Index], float]:
        each = interval_score(rows.left, prediction.low, prediction.high)
        return lambda i: float(each[i].mean() / constant_interval_score(rows.left[i]))

    scores = []
    for words, goals, prediction in (("", ("0.88-0.92", "<= 0.70"), ours), ("without physics: ", ("", ""), bare)):
        middle = np.abs(quantile(prediction.by, 0.5) - rows.left)
        interval = "" if words else "90 % interval, "
        scores += [
            scored(f"{words}{interval}coverage", goals[0], rows.life, coverage(prediction, rows.left)),
            scored(f"{words}interval score over a constant's", goals[1], rows.life, over_constant(prediction)),
            scored(f"{words}error of the middle [s]", "", rows.life, middle),
        ]
    covered = coverage(ours, rows.left)
    for k in np.unique(rows.kind):
        share = float(covered[rows.kind == k].mean())
        scores.append(Score(f"dust kind {k + 1} left out: coverage", share, np.nan, np.nan, ""))

    def draw(figure: Figure) -> None:
        for k, life in enumerate(np.unique(rows.life)[:: max(1, np.unique(rows.life).size // 4)][:4]):
            own = rows.life == life
            axes = figure.add_subplot(1, 4, k + 1)
            axes.fill_between(rows.second[own], ours.low[own], ours.high[own], alpha=0.3, label="90 % interval")
            axes.plot(rows.second[own], rows.left[own], "k", label="true")
            axes.set(title=f"filter {life + 1}", xlabel="time [s]", ylabel="seconds left")
        axes.legend()

    return Result(scores, draw)


RECIPE = Recipe(
    name="filters",
    title="Air filters clogged to failure",
    folder="filter*",
    wants="train.csv",
    source="Hagmeyer, Mauthe and Zeiler, Esslingen University (Preventive to Predictive Maintenance); `train.csv`",
    licence="none is stated: used, not shipped",
    anchor="none for whole lives with a dust kind left out: a constant interval, the same learner without physics",
    run=run,
)
