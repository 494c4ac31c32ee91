"""The nominal-leg filter against known truth: `python -m benchmarks.legs [--reference FOLDER]`.

Claims: a yield of at least 0.82 at a contamination of at most 0.05, along a curve of 0 to 45 % sick legs and not at one
point; better than classical Mahalanobis rejection, which masks, and than rules alone; ramps of all driving signals
found at 97 % or more with 0.5 % or less false; the phases of a real A320 flight; seconds for 10,000 flights.

The fleets are simulated (`hdt_core.simulate`), their faults and wear as they come; a point of the curve keeps a random
part of the sick or of the sound legs. No twin takes part: this is the filter a first calibration has to live with,
and a worn compressor, which only the twin sees, counts as sound.
"""

import argparse
import gzip
import json
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.stats import chi2

from benchmarks.chain import admit_fleet
from benchmarks.fleets import simulate_record
from hdt_core.flight.cross_checks import LEG_CHECKS, TOLERANCE, check_sensors, learn_outlet_law
from hdt_core.flight.legs import judge_legs
from hdt_core.flight.manifold import learn_manifold
from hdt_core.flight.nominal_baseline import NominalBaseline, leg_indicators
from hdt_core.flight.phases import add_phases
from hdt_core.flight.steady import SLOPE_T_LIMIT, WINDOW_S
from hdt_core.flight.windows import number_flights
from hdt_core.records.keys import LEG
from hdt_core.simulate.design import FleetSettings

SIZE = FleetSettings(operators=2, tails=3, flights=300, cpl_share=0.0)
SEEDS = (11, 12, 13, 14)
SHARES = (0.0, 0.05, 0.10, 0.20, 0.30, 0.45)
KEY = ["tail", "flight_id", "pack"]


class Fleet(NamedTuple):
    """Samples and first verdicts of a simulated fleet, its logs and its truth."""

    legs: pl.DataFrame
    samples: pl.DataFrame
    maintenance: pl.DataFrame
    messages: pl.DataFrame
    truth: pl.DataFrame
    seconds: float
    flights: int


def fleet_of(seed: int, size: FleetSettings = SIZE) -> Fleet:
    record = simulate_record(seed, size)
    snapshots, maintenance, messages = (record[name] for name in ("snapshots", "maintenance", "messages"))
    truth = record["health"].filter("arrived").with_columns(pl.col("pack").cast(pl.Int32))
    start = time.process_time()
    legs, samples = judge_legs(snapshots, maintenance.clear(), messages.clear())
    cpu_s = time.process_time() - start
    return Fleet(legs, samples, maintenance, messages, truth, cpu_s, snapshots["flight_id"].n_unique())


def thinned(fleet: Fleet, share: float, seed: int) -> Fleet:
    """A random part of the sick or of the sound legs, so that `share` of those left are contaminants."""
    rng = np.random.default_rng(seed)
    sick = fleet.truth["contaminant"].to_numpy()
    n_sick, n_sound = sick.sum(), (~sick).sum()
    keep_sick = min(1.0, share * n_sound / ((1.0 - share) * n_sick))
    keep_sound = min(1.0, (1.0 - share) * n_sick / max(share * n_sound, 1e-9))
    keep = rng.random(sick.size) < np.where(sick, keep_sick, keep_sound)
    truth = fleet.truth.filter(keep)
    legs, samples = (
        t.join(truth.select(KEY), on=KEY, how="semi", maintain_order="left") for t in (fleet.legs, fleet.samples)
    )
    return fleet._replace(truth=truth, legs=legs, samples=samples)


def classical(fleet: Fleet) -> pl.DataFrame:
    """The peer: rules, then mean and covariance of the same leg quantities, and a chi-square limit."""
    legs_by_number = number_flights(fleet.legs.drop("flight_number"))
    signs = leg_indicators(
        fleet.samples, NominalBaseline(learn_manifold(fleet.samples, legs_by_number), learn_outlet_law(fleet.samples))
    )
    columns = ["index_level", "index_unrest", *(f"{c}_off" for c in TOLERANCE if c in LEG_CHECKS)]
    vector = fleet.legs.join(signs, on=LEG, how="left", maintain_order="left").join(
        check_sensors(signs.select(*LEG, *LEG_CHECKS), legs_by_number), on=LEG, how="left", maintain_order="left"
    )
    x = vector.select(pl.col(c).fill_null(pl.col(c).median()).fill_nan(0.0) for c in columns).to_numpy()
    off = x - x.mean(axis=0)
    far = np.einsum("ij,jk,ik->i", off, np.linalg.pinv(np.cov(x.T)), off) > chi2.ppf(0.99, x.shape[1])
    return fleet.legs.with_columns(pl.col("admitted") & ~pl.Series(far))


def scored(legs: pl.DataFrame, truth: pl.DataFrame) -> tuple[float, float]:
    """Yield of the nominal, contamination of the admitted."""
    joined = truth.join(legs.select(*KEY, "admitted"), on=KEY, how="left")
    admitted = joined.filter("admitted")
    return float(joined.filter("nominal")["admitted"].mean()), float(admitted["contaminant"].mean() or 0.0)


def contamination_curve() -> None:
    fleets = {seed: fleet_of(seed) for seed in SEEDS}
    filters = {
        "two levels": lambda f: admit_fleet(f.legs, f.samples, f.maintenance, f.messages),
        "classical": classical,
        "rules alone": lambda f: f.legs,
    }
    print(f"mean of {len(SEEDS)} fleets: yield / contamination")
    for share in SHARES:
        line = [f"sick {share:4.0%}"]
        for name, judge in filters.items():
            points = [scored(judge(part := thinned(f, share, seed)), part.truth) for seed, f in fleets.items()]
            yielded, contaminated = np.mean(points, axis=0)
            line.append(f"{name} {yielded:.3f} / {contaminated:.3f}")
        print("   ".join(line))
    rate = sum(f.seconds for f in fleets.values()) / sum(f.flights for f in fleets.values())
    print(f"level one: {1e4 * rate:.1f} s CPU for 10,000 flights of snapshots, both packs")


def slope_test(x: np.ndarray) -> np.ndarray:
    """The house's t test of a slope (`steady.drift_free`) over the 60 s around each second."""
    offset = np.arange(WINDOW_S) - 0.5 * (WINDOW_S - 1)
    ss_time = offset @ offset
    slope = np.convolve(x, offset[::-1], mode="valid") / ss_time
    windows = np.lib.stride_tricks.sliding_window_view(x, WINDOW_S)
    variance = (windows.var(axis=1) * WINDOW_S - slope**2 * ss_time) / (WINDOW_S - 2)
    drifts = np.abs(slope) > SLOPE_T_LIMIT * np.sqrt(variance / ss_time)
    return drifts[np.clip(np.arange(x.size) - WINDOW_S // 2, 0, drifts.size - 1)]


def cao_rhinehart(x: np.ndarray, weight: float = 0.05, limit: float = 2.0) -> np.ndarray:
    """The peer: ratio of two filtered variances, J. Process Control 5(6), 1995."""
    mean, about, between = x[:60].mean(), x[:60].var(), 2.0 * x[:60].var()
    out = np.zeros(x.size, dtype=bool)
    for k in range(1, x.size):
        about += weight * ((x[k] - mean) ** 2 - about)
        mean += weight * (x[k] - mean)
        between += weight * ((x[k] - x[k - 1]) ** 2 - between)
        out[k] = (2.0 - weight) * about / between > limit
    return out


def ramps() -> None:
    print("ramps of 300 s in noise of sd 1: share of ramp seconds found / of steady seconds called ramp")
    for rise in (15.0, 20.0, 30.0, 60.0):
        rates = {"slope test": [], "Cao-Rhinehart": []}
        for seed in range(20):
            x, ramp = np.random.default_rng(seed).normal(size=2400), np.zeros(2400, dtype=bool)
            x += np.interp(np.arange(2400), [1000, 1300], [0.0, rise])
            ramp[1000:1300] = True
            far = np.abs(np.arange(2400) - 1150) > 180
            for name, test in (("slope test", slope_test), ("Cao-Rhinehart", cao_rhinehart)):
                called = test(x)
                rates[name].append((called[ramp].mean(), called[far].mean()))
        cells = [f"{name} {np.mean(v, axis=0)[0]:.3f} / {np.mean(v, axis=0)[1]:.4f}" for name, v in rates.items()]
        print(f"rise {rise:3.0f} sd   " + "   ".join(cells))


def real_flight(reference: Path) -> None:
    record = json.loads(gzip.decompress((reference / "flight_a320" / "fuelflow_a320.json.gz").read_bytes()))
    column = record["altitude"]
    feet = np.asarray(list(column.values()) if isinstance(column, dict) else column, dtype=float)
    start = pl.lit(datetime(2024, 1, 1, tzinfo=UTC), pl.Datetime("us", "UTC"))
    flown = pl.DataFrame({"altitude_m": 0.3048 * feet}).with_columns(
        pl.lit("A320").alias("tail"), (start + pl.duration(seconds=pl.int_range(pl.len()))).alias("time_utc")
    )
    phase = add_phases(flown, by=("tail",))["phase"].to_numpy()
    second = np.arange(phase.size)
    openap = np.where(second < 1799, "climb", np.where(second < 10379, "cruise", "descent"))
    cruise = np.flatnonzero(phase == "cruise")
    print(
        f"A320: {np.mean((phase == openap)[:11759]):.2%} of seconds as openap, top of climb {cruise[0] - 1799:+d} s, "
        f"top of descent {cruise[-1] + 1 - 10379:+d} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--reference", type=Path, help="folder of the reference data, for the real A320 flight")
    reference = parser.parse_args().reference
    if reference:
        real_flight(reference)
    ramps()
    contamination_curve()


if __name__ == "__main__":
    main()
