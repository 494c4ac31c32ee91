"""Health per flight against known truth: `python -m benchmarks.twin [--seeds 101-124] [--write]`.

Claims: fouling within 0.015 of what an observer of the clean duct's ram flow would call the loss; noise, order, and an
honest standard deviation; effective diameter and efficiency loss of the compressor; seconds for 100,000 flights. Peers
in the same run: each flight alone, without the sequential pass (what the noise would be), and the truth's own limit,
the same record read by one who knows each unit's offset.

The fleets are simulated by `hdt_core.simulate`, two operators of four aircraft and 350 flights each, every seed with
its own design, sensors, recorders and habits; none was left out. Half of them have no ram outlet sensor on some or all
aircraft, and 40 % of first units enter worn.
"""

import time
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.chain import admit_fleet
from benchmarks.fleets import fleet_of
from benchmarks.harness import DOCS, Texts, markdown, run
from hdt_core.calibration.calibrate import calibrate
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.flight.legs import baseline_flights
from hdt_core.records.keys import IN_ORDER
from hdt_core.robust import Z_90, spread_expr
from hdt_core.simulate.design import FleetSettings
from hdt_core.tracking.track import track

KEY = ["tail", "flight_id", "pack"]
UNIT = ["tail", "pack", "hx_unit"]
GOALS = {
    "fouling, mean absolute error": "<= 0.015", "fouling, noise of healthy packs": "<= 0.003",
    "fouling, Spearman of wearing packs": ">= 0.96", "coverage of 90 %": "0.88-0.92",
    "mean standard deviation": "<= 0.022", "interval score": "<= 0.10", "effective diameter, error [m]": "<= 0.0004",
    "efficiency loss, error": "<= 0.004",
}  # fmt: skip


class Fleet(NamedTuple):
    """Estimates of one simulated fleet beside its truth, and what they cost."""

    seed: int
    ram_seen: bool
    rows: pl.DataFrame
    flights: int
    seconds: float


def fleets(seeds: range, size: FleetSettings) -> Iterator[Fleet]:
    """Calibrate, estimate and track each fleet as a night would."""
    for seed in seeds:
        flown = fleet_of(seed, size)
        within = pl.col("flight_id").is_in(baseline_flights(flown.legs))
        logs = flown.maintenance.clear(), flown.messages.clear()
        admitted = admit_fleet(flown.legs.filter(within), flown.samples.filter(within), *logs)
        model = calibrate(flown.samples, admitted, flown.maintenance)
        start = time.process_time()
        alone = estimate_flights(flown.samples, model)
        health = track(alone, flown.maintenance, model).health
        seconds = time.process_time() - start
        truth = flown.truth.with_columns(a=1.0 - pl.col("apparent_ua_ratio"), t=1.0 - pl.col("ua_ratio"))
        alone_loss = alone.select(*KEY, single=1.0 - (pl.col("ln_ua_ratio") - model.clean_level).exp())
        rows = health.filter(pl.col("value").is_not_null()).join(truth, on=KEY, suffix="_true").join(alone_loss, on=KEY)
        rows = rows.with_columns(seed=pl.lit(seed)).sort("parameter", *IN_ORDER)
        yield Fleet(seed, model.ram_balance_seen, rows, flown.samples["flight_id"].n_unique(), seconds)


def per_pack(frame: pl.DataFrame, expr: pl.Expr) -> float:
    """Median over packs."""
    return float(frame.group_by("seed", "tail", "pack").agg(expr.alias("v"))["v"].drop_nulls().drop_nans().median())


def interval_score(error: np.ndarray, sd: np.ndarray) -> np.ndarray:
    """Width of the 90 % interval and 20 times what falls outside (Gneiting and Raftery 2007)."""
    return 2.0 * Z_90 * sd + 20.0 * np.maximum(np.abs(error) - Z_90 * sd, 0.0)


def fouling_numbers(rows: pl.DataFrame) -> dict[str, float]:
    """The heat exchanger's rows of the table, from `hx_fouling` of one or more fleets."""
    f = rows.filter(pl.col("parameter") == "hx_fouling").with_columns(e=pl.col("value") - pl.col("a"))
    healthy = f.filter((pl.max_horizontal("a", "t") < 0.05) & ~pl.col("contaminant"))
    pack = ["seed", "tail", "pack"]
    rolling = pl.col("value") - pl.col("value").rolling_median(21, center=True, min_samples=5).over(pack)
    wearing = f.filter((pl.col("t").max() - pl.col("t").min()).over(pack) > 0.05)
    error = f["e"].to_numpy()
    sd = f["sd"].to_numpy()
    return {
        "fouling, mean absolute error": per_pack(f, pl.col("e").abs().mean()),
        "fouling, noise of healthy packs": per_pack(healthy.with_columns(r=rolling), spread_expr(pl.col("r"))),
        "fouling, Spearman of wearing packs": per_pack(wearing, pl.corr("value", "t", method="spearman")),
        "coverage of 90 %": float(np.mean(np.abs(error) < Z_90 * sd)),
        "mean standard deviation": float(sd.mean()),
        "interval score": float(interval_score(error, sd).mean()),
    }


def compressor_numbers(rows: pl.DataFrame) -> dict[str, float]:
    """The compressor's rows of the table."""
    flying = rows.filter(~pl.col("pack_off"))
    errors = {}
    for name, parameter, true in (
        ("effective diameter, error [m]", "cc_effective_diameter_m", "cc_eff_diameter_m"),
        ("efficiency loss, error", "cc_efficiency_loss", "cc_eff_loss"),
    ):
        part = flying.filter(pl.col("parameter") == parameter)
        errors[name] = per_pack(part, (pl.col("value") - pl.col(true)).abs().mean()) if part.height else float("nan")
    return errors


def limits(rows: pl.DataFrame) -> list[tuple[str, float, float]]:
    """Mean absolute error and best interval score where the sequential pass is taken away, or its ignorance."""
    f = rows.filter(pl.col("parameter") == "hx_fouling").with_columns(e=pl.col("value") - pl.col("a"))
    lone = f.drop_nulls("single").with_columns(e=pl.col("single") - pl.col("a"))
    without_offset = f.with_columns(e=pl.col("e") - pl.col("e").median().over("seed", *UNIT))
    parts = {
        "each flight alone": lone,
        "this filter": f,
        "of which first units": f.filter(pl.col("hx_unit") == 0),
        "of which replaced units": f.filter(pl.col("hx_unit") > 0),
        "this filter, had it known each unit's offset": without_offset,
    }
    return [(name, float(p["e"].abs().mean()), best_score(p["e"].to_numpy())) for name, p in parts.items()]


def best_score(error: np.ndarray) -> float:
    """Least interval score that one constant width can have with these errors."""
    widths = np.quantile(np.abs(error), np.linspace(0.5, 0.99, 50)) / Z_90
    return float(min(interval_score(error, np.full(len(error), w)).mean() for w in widths))


def bootstrap(rows: pl.DataFrame, name: str, draws: int) -> tuple[float, float]:
    """5th and 95th percentile of a number over fleets drawn with replacement."""
    rng = np.random.default_rng(0)
    by_fleet = rows.partition_by("seed")
    numbers = []
    for _ in range(draws):
        picks = rng.integers(0, len(by_fleet), len(by_fleet))
        resampled = pl.concat(by_fleet[k].with_columns(seed=pl.lit(j)) for j, k in enumerate(picks))
        fouling = fouling_numbers(resampled)
        numbers.append((fouling if name in fouling else compressor_numbers(resampled))[name])
    return float(np.quantile(numbers, 0.05)), float(np.quantile(numbers, 0.95))


def tables(results: list[Fleet], draws: int) -> str:
    """Markdown of both tables."""
    rows = pl.concat(f.rows for f in results)
    labels = {True: "ram outlet on some aircraft", False: "on none"}
    groups = {word: [f.seed for f in results if f.ram_seen is flag] for flag, word in labels.items()}
    numbers = fouling_numbers(rows) | compressor_numbers(rows)
    head = ["what", "goal", "all fleets", "90 % by fleet", *(f"{w} ({len(s)})" for w, s in groups.items())]
    lines = [head]
    parts = [rows.filter(pl.col("seed").is_in(s)) for s in groups.values()]
    own = [fouling_numbers(p) | compressor_numbers(p) if p.height else {} for p in parts]
    for name, goal in GOALS.items():
        low, high = bootstrap(rows, name, draws)
        digits = 5 if "[m]" in name else 4
        cells = [name, goal, f"{numbers[name]:.{digits}f}", f"{low:.{digits}f} - {high:.{digits}f}"]
        cells += [f"{o[name]:.{digits}f}" if o else "-" for o in own]
        lines.append(cells)
    rate = 1e5 * sum(f.seconds for f in results) / sum(f.flights for f in results)
    cost = (
        f"{len(results)} fleets, {sum(f.flights for f in results)} flights; estimation and tracking take {rate:.0f} s"
    )
    cost += " of one processor for 100,000 flights, both packs, exchanger and compressor."
    reads = [["hx_fouling as read by", "mean absolute error", "least interval score of a constant width"]]
    reads += [[n, f"{e:.4f}", f"{s:.3f}"] for n, e, s in limits(rows)]
    return f"{markdown(lines)}\n\n{cost}\n\n{markdown(reads)}"


def main(seeds: str = "101-124", flights: int = 350, draws: int = 40) -> Texts:
    """First and last seed; flights of each aircraft; bootstrap draws."""
    first, last = map(int, seeds.split("-"))
    size = FleetSettings(operators=2, tails=4, flights=flights, cpl_share=0.0)
    yield "tables", tables(list(fleets(range(first, last + 1), size)), draws)


if __name__ == "__main__":
    run(main, page=DOCS / "calibration.md")
