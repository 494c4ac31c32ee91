"""Detection and diagnosis on simulated fleets: `python -m benchmarks.detection [seeds] [tails] [flights]`.

Claims: faults of door and sensors are told from wear at no more than one false alarm in 1,000 flights; on the same
witness and at equal false alarms the detector finds shifts no later than the EWMA chart of Roberts (1959), whose offset
is the unit's first flights, nor than a strong tracking filter with modified Bayes classification. Simulated fleets may
show that a method works; they don't score the product.
"""

import sys
from collections import defaultdict
from collections.abc import Callable

import numpy as np
import polars as pl
from scipy.special import logit

from benchmarks.fleets import fly, sound_seeds
from hdt_core.estimation import Belief, Problem
from hdt_core.health.detection import Array, Cusum, watch
from hdt_core.simulate.design import FleetSettings
from hdt_estimators import StrongTracking
from hdt_estimators.strong_tracking import classify

GROUP = {
    "HX_FOULING": "HX",
    "HX_SUDDEN_CLOG": "HX",
    "HX_LOW_MARGIN": "HX",
    "CC_DEGRADED": "CC",
    "RAM_DOOR_FAULT": "RAM_DOOR",
    "SENSOR_FAULT": "SENSOR",
}


def place_alerts(alerts: pl.DataFrame, truth: pl.DataFrame) -> pl.DataFrame:
    """Alerts with the flight number of their raising, and whether anything was wrong there."""
    wrong = (pl.col("sensor_fault") != "") | pl.col("door_fault") | pl.col("icing")
    loss = 1.0 - pl.min_horizontal("ua_ratio", "apparent_ua_ratio")
    about = truth.sort("tail", "pack", "index").select(
        "tail",
        pl.col("pack").cast(pl.Int32),
        pl.col("flight_id").alias("raised_flight_id"),
        "index",
        (wrong.cast(pl.Int8).rolling_max(11, min_samples=1).shift(-2).forward_fill().over("tail", "pack") > 0).alias(
            "faulty"
        ),
        ((loss >= 0.05) | (pl.col("cc_eff_loss") >= 0.05)).alias("worn"),
    )
    group = pl.col("diagnosis").replace_strict(GROUP).alias("group")
    return alerts.join(about, on=["tail", "pack", "raised_flight_id"], how="left").with_columns(group)


def match_alerts(fleet: dict[str, pl.DataFrame], tally: dict[str, list[float | None]]) -> tuple[int, int]:
    """Add each true event's delay (None where missed) to `tally`; return false alarms and flights."""
    alerts = place_alerts(fleet["alerts"], fleet["truth"])
    for event in fleet["events"].iter_rows(named=True):
        component, start = event["component"], event["onset_index"]
        end = event["message_index"] if component in ("HX", "CC") else event["removal_index"]
        if start is None or (component in ("HX", "CC") and end is None):
            continue
        hits = alerts.filter(
            (pl.col("tail") == event["tail"])
            & (pl.col("pack") == event["pack"])
            & (pl.col("group") == component)
            & pl.col("index").is_between(
                start, (end if end is not None else 10**6) + (0 if component in ("HX", "CC") else 3)
            )
        )["index"]
        kind = component if component in ("HX", "CC") else str(event["kind"])
        tally[kind].append(None if hits.is_empty() else float(hits.min()) - start)
    false = alerts.filter(~pl.col("faulty") & ~pl.col("worn")).height
    return false, fleet["truth"].filter("arrived")["flight_id"].n_unique()


def ewma_calls(values: Array, sd: float, limit: float, weight: float = 0.2, learn: int = 10) -> Array:
    """EWMA chart (Roberts 1959) about the mean of each unit's first flights. (units, flights) bool"""
    centre = values[:, :learn].mean(axis=1, keepdims=True)
    out, level = np.zeros(values.shape, dtype=bool), np.zeros(values.shape[0])
    for k in range(learn, values.shape[1]):
        level = (1 - weight) * level + weight * (values[:, k] - centre[:, 0])
        out[:, k] = np.abs(level) > limit * sd * np.sqrt(weight / (2 - weight))
    return out


def first_calls(calls: Array, onset: int) -> tuple[float, float]:
    """Calls per 1,000 flights before the onset, and median delay after it (the end where never called)."""
    rising = calls[:, :onset] & ~np.pad(calls[:, :onset], ((0, 0), (1, 0)))[:, :-1]
    after = calls[:, onset:]
    delay = np.where(after.any(axis=1), after.argmax(axis=1), after.shape[1])
    return 1000.0 * float(rising.sum()) / rising.size, float(np.median(delay))


def strong_tracking_odds(values: Array, sd: float, learn: int = 10) -> Array:
    """Log odds of a shift after each flight: strong tracking filter, modified Bayes classification. (units, flights)

    The nominal value is the mean of a unit's first flights, and may wander by the 0.3 K that season and ageing bring.
    """
    out = np.full(values.shape, -np.inf)
    for unit, row in enumerate(values):
        nominal = Belief(row[:learn].mean(keepdims=True), np.array([[0.3**2 + sd**2 / learn]]))
        problem = Problem(
            names=("offset_k",),
            bounds=np.array([[-np.inf, np.inf]]),
            prior=nominal,
            measured=row[:, None],
            sigma=np.array([sd]),
            observe=lambda _x, theta, i: np.asarray(theta[0])[None],
            drift=np.array([0.02]),
        )
        classification = classify(problem.names, StrongTracking().estimate(problem), nominal, window=10)
        out[unit, learn:] = logit(np.clip(classification.probability[learn:, 0], 1e-15, 1.0 - 1e-15))
    return out


def at_equal_calls(called: Callable[[float], Array], levels: Array, onset: int, calls: float) -> tuple[float, float]:
    """Calls and delay at the first level that calls no more often before the onset; the strictest where none does."""
    for level in levels:
        now = first_calls(called(float(level)), onset)
        if now[0] <= calls:
            break
    return now


def duel() -> None:
    """CUSUM with a learned offset against an EWMA chart and a strong tracking filter, on noise with ageing and season.

    The filter steps in plain Python, so it is asked about fewer units than the charts.
    """
    rng = np.random.default_rng(0)
    units, few, flights, onset, sd = 400, 40, 700, 600, 0.8
    ageing = rng.normal(0.0, 0.001, (units, 1)) * np.arange(flights)
    season = 0.3 * np.sin(2 * np.pi * (np.arange(flights) / 350.0 + rng.random((units, 1))))
    sound = rng.normal(0.0, sd, (units, flights)) + rng.normal(0.0, 1.5, (units, 1)) + ageing + season
    after = np.arange(flights - onset)
    faults = {
        "step 2 K": np.full(after.size, 2.0),
        "step 4 K": np.full(after.size, 4.0),
        "drift 0.1 K/flight": 0.1 * after,
    }
    print(
        f"\nleft against right outlet: sd {sd} K, ageing 1 K in 1,000 flights, season 0.3 K; {units} units ({few} for"
    )
    print("the filter), each contestant no more calls before the fault than the CUSUM. calls: in 1,000 sound flights;")
    print("delay: median, flights; x: delay over the CUSUM's, plus one each")
    print(f"{'fault':20}" + "".join(f"{n:>16}{'delay':>7}{'x':>6}" for n in ("CUSUM", "EWMA 1959", "strong tracking")))
    for name, fault in faults.items():
        values = sound.copy()
        values[:, onset:] += fault
        shift = watch(values[:, :, None], np.array([sd]), np.zeros((*values.shape, 1), dtype=bool), Cusum())
        ours = first_calls(shift.alarm[:, :, 0], onset)
        odds, budget = strong_tracking_odds(values[:few], sd), max(ours[0], 0.01)
        ewma = at_equal_calls(lambda x, v=values: ewma_calls(v, sd, x), np.arange(3.0, 15.0, 0.1), onset, budget)
        tracking = at_equal_calls(lambda x, o=odds: o > x, np.arange(0.0, 34.0, 0.25), onset, budget)
        cells = (f"{c:16.3f}{d:7.0f}{(d + 1) / (ours[1] + 1):6.2f}" for c, d in (ours, ewma, tracking))
        print(f"{name:20}" + "".join(cells))


def main() -> None:
    seeds, tails, flights = (int(a) for a in (sys.argv[1:] + ["3", "3", "300"][len(sys.argv) - 1 :])[:3])
    settings = FleetSettings(operators=2, tails=tails, flights=flights, cpl_share=0.0)
    tally: dict[str, list[float | None]] = defaultdict(list)
    false = flown = 0
    for seed in sound_seeds(0, seeds):
        more, counted = match_alerts(fly(seed, settings), tally)
        false, flown = false + more, flown + counted
    print(
        f"{seeds} simulated fleets, {flown} flights: {1000 * false / max(flown, 1):.2f} false alarms per 1,000 flights"
    )
    print("event                           n  alerted  median delay [flights]")
    for kind, delays in sorted(tally.items()):
        alerted = [d for d in delays if d is not None]
        middle = f"{np.median(alerted):.0f}" if alerted else "-"
        print(f"{kind:28} {len(delays):4} {len(alerted) / len(delays):8.0%}  {middle}")
    duel()


if __name__ == "__main__":
    main()
