"""A hydraulic rig's oil cooler, throttled on purpose: conductance by cycle, from measured flow where it is there.

The component is that of docs/howto-component.md. Without the flow sensors the oil's heat-capacity rate is what the
rig's two virtual sensors imply; with FS2, the flow through the cooler, it is measured.
"""

from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.model_selection import GroupKFold, cross_val_predict

from benchmarks.real.recipe import Array, Recipe, Result, scored
from hdt_core.calibration.component_fit import calibrate_component, flight_by_flight
from hdt_core.physics.effectiveness import counterflow_effectiveness
from hdt_core.physics.model import Param, PhysicsModel, Signal

FULL, LEAST = 100, 3
AS_BUILT = 200
"""Cycles at full duty that the cooler is calibrated on."""
OIL_J_L_K = 0.86 * 1900.0
"""Heat capacity of a litre of the oil at working temperature: HLP 46. [J/(l K)]"""


def oil_outlet_k(*, oil_capacity_w_k, oil_in_k, air_in_k, hc_ua_w_k, hc_fouling):
    """Oil temperature behind the cooler: conductance UA, of which fouling takes a share. [K]"""
    ntu = (1.0 - hc_fouling) * hc_ua_w_k / oil_capacity_w_k
    return oil_in_k - counterflow_effectiveness(ntu, 0.0) * (oil_in_k - air_in_k)


COOLER = PhysicsModel(
    name="hydraulic_cooler",
    inputs=(Signal("oil_capacity_w_k", "W/K"), Signal("oil_in_k", "K"), Signal("air_in_k", "K")),
    outputs=(Signal("oil_out_k", "K", sigma=0.1),),
    params=(
        Param("hc_ua_w_k", "W/K", 150.0, (20.0, 1000.0), "design"),
        Param("hc_fouling", "-", 0.0, (-0.25, 0.95), "health", drift=0.02),
    ),
    equations=oil_outlet_k,
)


def sensor(folder: Path, name: str) -> Array | None:
    """Cycles by seconds; of faster sensors the mean of each second; None where the file is absent."""
    file = next(folder.glob(f"{name}.txt*"), None)
    if file is None:
        return None
    rows = np.loadtxt(file)
    return np.asarray(rows.reshape(len(rows), 60, -1).mean(axis=2))


def samples(folder: Path) -> tuple[pl.DataFrame, bool]:
    """Every second of every cycle in SI, and whether the flow was measured."""
    hot, cold, efficiency, power = (sensor(folder, n) for n in ("TS3", "TS4", "CE", "CP"))
    flow = sensor(folder, "FS2")
    drop = np.maximum(hot - cold, 0.1)
    air = np.median(hot - 100.0 * drop / efficiency, axis=1, keepdims=True)
    implied = np.median(1e3 * power / drop, axis=1, keepdims=True)
    rate = implied if flow is None else np.median(flow, axis=1, keepdims=True) / 60.0 * OIL_J_L_K
    cycle = np.repeat(np.arange(len(hot)), 60)
    second = pl.Series(np.tile(np.arange(60), len(hot)))
    at = {"oil_in_k": hot + 273.15, "oil_out_k": cold + 273.15}
    wide = {"oil_capacity_w_k": rate, "air_in_k": air + 273.15}
    values = {n: v.ravel() for n, v in at.items()} | {n: np.broadcast_to(v, hot.shape).ravel() for n, v in wide.items()}
    frame = pl.DataFrame({"operator": "RIG", "tail": "COOLER", "cycle": cycle} | values).with_columns(
        pl.lit(1, pl.Int32).alias("pack"),
        pl.format("CYCLE-{}", pl.col("cycle").cast(pl.String).str.zfill(4)).alias("flight_id"),
        (pl.datetime(2015, 1, 1, time_zone="UTC") + pl.duration(minutes="cycle", seconds=second)).alias("time_utc"),
    )
    return frame, flow is not None


def conductances(folder: Path) -> tuple[pl.DataFrame, bool]:
    """Settled cycles: UA, the cooler's duty, and which run of unchanged settings they belong to."""
    readings, measured = samples(folder)
    profile_rows = np.loadtxt(folder / "profile.txt").astype(int)
    names = ("duty_pct", "valve_pct", "pump_leakage", "accumulator_bar", "unstable")
    profile = pl.DataFrame(profile_rows, schema=list(names), orient="row").with_row_index("cycle").cast(pl.Int64)
    profile = profile.with_columns(run=pl.struct(names[:4]).rle_id())
    settled = profile.filter(pl.col("unstable") == 0)
    readings = readings.join(settled.select("cycle"), on="cycle", how="semi")
    built = settled.filter(pl.col("duty_pct") == FULL).head(AS_BUILT)
    dsm, _ = calibrate_component(COOLER, readings.join(built.select("cycle"), on="cycle", how="semi"))
    flights = flight_by_flight(readings, dsm, ["hc_fouling"])
    ua = (dsm.nominal["hc_ua_w_k"] * (1.0 - pl.col("hc_fouling"))).alias("ua_w_k")
    number = pl.col("flight_id").str.slice(6).cast(pl.Int64).alias("cycle")
    return settled.join(flights.select(number, ua), on="cycle"), measured


def wander(rows: pl.DataFrame, duty: int) -> float:
    """How far a level of another fault takes the median conductance at one duty, at most. [share]"""
    own = rows.filter(pl.col("duty_pct") == duty)
    middle = own["ua_w_k"].median()
    levels = [own.group_by(f).agg(pl.col("ua_w_k").median()) for f in ("valve_pct", "pump_leakage", "accumulator_bar")]
    return float(max((level["ua_w_k"] / middle - 1.0).abs().max() for level in levels))


def run(folder: Path) -> Result:
    """Settled cycles."""
    rows, measured = conductances(folder)
    group = rows["run"].to_numpy()
    x = rows.select(pl.col("ua_w_k").log()).to_numpy()
    y = rows["duty_pct"].to_numpy()
    right = cross_val_predict(LinearDiscriminantAnalysis(), x, y, groups=group, cv=GroupKFold(10)) == y
    scores = [scored("duty class from UA alone, runs left out", ">= 0.99", group, right)]
    for duty in sorted(set(y.tolist()), reverse=True):
        name = f"cooler at {duty} %: moved by other faults, at most"
        goal = "<= 0.03" if duty == LEAST else ""
        scores.append(scored(name, goal, group, lambda i, duty=duty: wander(rows[i], duty)))

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.plot(rows["cycle"], rows["ua_w_k"], ".", ms=2)
        axes.set(xlabel="cycle", ylabel="conductance [W/K]")

    words = "" if measured else "FS2 is absent here: the flow is the one that the rig's virtual sensors imply."
    return Result(scores, draw, words)


RECIPE = Recipe(
    name="hydraulic",
    title="A hydraulic rig's oil cooler",
    folder="hydraulic*",
    wants="profile.txt",
    source="UCI repository 447 (Helwig, Pignanelli, Schuetze 2015, doi 10.1109/I2MTC.2015.7151267); "
    "TS3, TS4, CE, CP, FS2, profile",
    licence="CC BY 4.0",
    anchor="condition told without error by linear discriminants over features of all sensors (Helwig et al. 2015)",
    run=run,
)
