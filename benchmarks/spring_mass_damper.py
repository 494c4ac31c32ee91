"""Section 3.2.2 of the paper reproduced: every estimator on the spring-mass-damper, from the same wrong guess.

Run ``python -m benchmarks.spring_mass_damper [--quick] [--seeds N] [--slow-seeds N] [--workers N] [--plots DIR]
[--write]``. Prints tables 1 and 2 beside the paper's numbers and what the paper does not state: bias, Cramér-Rao ratio,
coverage, failures; draws figures 8 and 9. ``--quick`` takes few records, under a minute; the other numbers are records
of the fast methods and of those that take long. ``--write`` puts the tables into docs/benchmark.md. Times are those of
the processor, one thread, so that neighbours on the machine do not count.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from matplotlib import rcParams
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

from benchmarks.harness import Texts, markdown, run
from hdt_benchmark.spring_mass_damper import TRUTH, oscillator_problem, true_position_m
from hdt_core.estimation import Estimate, Estimator, ExtendedKalman, ParticleSwarm, UnscentedKalman, estimators
from hdt_core.estimation.fit import fisher
from hdt_core.robust import Z_90

SLOW = {"pinn", "particle", "rls", "strong_tracking", "ekf_pso"}
PAPER = {  # tables 1 and 2: damping, stiffness, MSE, MAPE, seconds
    "ukf": (0.404, 1.959, 3.2e-4, 0.553, 0.022),
    "ekf": (0.5, 2.0, 2.6e-4, 0.502, 0.027),
    "pso": (0.472, 2.008, 3e-5, 0.213, 0.237),
    "nls": (0.472, 2.008, 3e-5, 0.213, 0.043),
}


@dataclass(frozen=True, slots=True)
class Row:
    """One estimator over all its records. Arrays are (damping, stiffness)."""

    name: str
    n_seeds: int
    first: Estimate  # of the record with seed 0, the one the figures show
    mean: np.ndarray
    sd: np.ndarray
    bias_to_bound: np.ndarray
    rmse_to_bound: np.ndarray
    coverage: np.ndarray
    failures: int
    mse_truth: np.ndarray  # median, 5 %, 95 % [m2]
    mape_truth: float
    seconds: float


def contestants() -> tuple[Estimator, ...]:
    """Every estimator with its default settings; the swarm as in the paper; filters with and without their
    smoother."""
    plain = (
        ExtendedKalman(name="ekf, no smoother", smoother_passes=0),
        UnscentedKalman(name="ukf, no smoother", smoother_passes=0),
    )
    return tuple(ParticleSwarm(polish=False) if e.name == "pso" else e for e in estimators().values()) + plain


def main(
    seeds: int = 200, slow_seeds: int = 20, estimators: Sequence[Estimator] | None = None, workers: int = 1
) -> list[Row]:
    """Estimate `seeds` records (`slow_seeds` for the methods that take long), estimators in turn on every record."""
    chosen = contestants() if estimators is None else tuple(estimators)
    last = {e.name: slow_seeds if e.name in SLOW else seeds for e in chosen}
    estimate = partial(_record, chosen, last)
    n_records = max(last.values())
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        run = map if workers == 1 else partial(pool.map, chunksize=5)
        records = list(track(run(estimate, range(n_records)), "Records", n_records, console=Console(stderr=True)))
    return [_row(e.name, [record[e.name] for record in records[: last[e.name]]]) for e in chosen]


def _record(chosen: Sequence[Estimator], last: dict[str, int], seed: int) -> dict[str, tuple[Estimate, float]]:
    """Estimate and seconds of every estimator whose turn includes this record; paths of the first record only."""
    timed = {}
    for estimator in chosen:
        if seed < last[estimator.name]:
            if estimator.name not in SLOW:
                _warm(estimator)
            problem = oscillator_problem(seed)
            with threadpool_limits(1):
                started = time.process_time()
                estimate = estimator.estimate(problem)
                seconds = time.process_time() - started
            timed[estimator.name] = (estimate if seed == 0 else replace(estimate, path=None, path_sd=None), seconds)
    return timed


@cache
def _warm(estimator: Estimator) -> None:
    """Load compiled code, once a process; of methods that take long it is a small part of the first record."""
    estimator.estimate(oscillator_problem(0))


def _row(name: str, records: list[tuple[Estimate, float]]) -> Row:
    bound = fisher(oscillator_problem(0), TRUTH).bound_sd
    theta = np.array([e.belief.mean for e, _ in records])
    sd = np.array([e.belief.sd for e, _ in records])
    error = theta - TRUTH
    truth = true_position_m()
    positions = oscillator_problem(0).simulate(theta)[:, :, 0]
    mse = ((positions - truth) ** 2).mean(axis=1)
    moving = truth != 0.0
    mape = (np.abs(positions - truth)[:, moving] / np.abs(truth[moving])).mean(axis=1)
    has_answer = np.array([e.status not in ("diverged", "not_identifiable") for e, _ in records])
    ended_well = has_answer & (np.abs(error) < 6.0 * sd).all(axis=1)
    return Row(
        name=name,
        n_seeds=len(records),
        first=records[0][0],
        mean=theta.mean(axis=0),
        sd=theta.std(axis=0),
        bias_to_bound=error.mean(axis=0) / bound,
        rmse_to_bound=np.sqrt((error**2).mean(axis=0)) / bound,
        coverage=(np.abs(error) < Z_90 * sd).mean(axis=0),
        failures=int((~ended_well).sum()),
        mse_truth=np.quantile(mse, [0.5, 0.05, 0.95]),
        mape_truth=float(np.median(mape)),
        seconds=float(np.median([s for _, s in records])),
    )


def tables(rows: list[Row]) -> str:
    """Tables 1 and 2 with the paper's columns, table 3 with what it lacks; pairs are damping, stiffness. Markdown."""
    by_name = {row.name: row for row in rows}
    five = [n for n in ("ukf", "ekf", "pso", "nls", "pinn") if n in by_name]
    head = ["", *(f"{n.upper()} {whose}" for n in five for whose in ("paper", "ours"))]

    def line(label: str, paper: int, ours: Sequence[str]) -> list[str]:
        printed = [f"{PAPER[n][paper]:g}" if n in PAPER else "-" for n in five]
        return [label, *(cell for pair in zip(printed, ours, strict=True) for cell in pair)]

    def spread(i: int) -> list[str]:
        return [f"{by_name[n].mean[i]:.3f} ± {by_name[n].sd[i]:.3f}" for n in five]

    one = [head, line("Damping coefficient [N s/m]", 0, spread(0)), line("Stiffness [N/m]", 1, spread(1))]
    two = [
        head,
        line("MSE against truth [m2]", 2, [f"{by_name[n].mse_truth[0]:.1e}" for n in five]),
        line("MAPE against truth [-]", 3, [f"{by_name[n].mape_truth:.3f}" for n in five]),
        line("Computation time [s]", 4, [f"{by_name[n].seconds:.5f}" for n in five]),
    ]
    columns = ["estimator", "records", "bias / bound", "RMSE / bound", "coverage of 90 %", "failures"]
    three = [[*columns, "MSE truth, median", "MSE truth, 5-95 %", "time [ms]"]]
    for r in rows:
        pairs = [_pair(r.bias_to_bound, "+.2f"), _pair(r.rmse_to_bound, ".3f"), _pair(r.coverage, ".3f")]
        middle, low, high = r.mse_truth
        errors = [f"{middle:.1e}", f"{low:.1e} - {high:.1e}"]
        three.append([r.name, f"{r.n_seeds}", *pairs, f"{r.failures}", *errors, f"{1e3 * r.seconds:.3g}"])
    titles = (
        "Table 1. Estimated parameters", "Table 2. Performance for position", "Table 3. What the paper does not state",
    )  # fmt: skip
    return "\n\n".join(f"**{t}**\n\n" + markdown(body) for t, body in zip(titles, (one, two, three), strict=True))


def _pair(values: np.ndarray, form: str) -> str:
    return f"{values[0]:{form}}, {values[1]:{form}}"


def figures(rows: list[Row], folder: Path) -> list[Path]:
    """Figures 8 and 9 of the paper, from the record with seed 0."""
    rcParams["svg.hashsalt"] = "spring-mass-damper"  # the same figures, byte for byte, every time
    problem = oscillator_problem(0)
    truth = true_position_m()
    t = 0.01 * np.arange(truth.size)
    folder.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(t, problem.measured[:, 0], ".", ms=2, color="0.6", label="measured, sd 0.05 m")
    axes.plot(t, truth, color="C0", label="simulated")
    axes.set(xlabel="time [s]", ylabel="position [m]", title="Data of the spring-mass-damper (figure 8)")
    axes.legend()
    paths = [folder / "spring_mass_damper_data.svg"]
    figure.savefig(paths[0], metadata={"Date": None})
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    grid = figure.subplots(2, 2)
    of_paper = [r for r in rows if r.name in ("ukf", "ekf", "pso", "nls", "pinn")]
    grid[0, 0].plot(t, problem.measured[:, 0], ".", ms=2, color="0.8", label="measured")
    for k, r in enumerate(of_paper):
        position = problem.simulate(r.first.belief.mean)[:, 0]
        grid[0, 0].plot(t, position, color=f"C{k}", lw=1, label=r.name)
        grid[0, 1].plot(t, 1e3 * (position - truth), color=f"C{k}", lw=1, label=r.name)
    for axis, i, name in ((grid[1, 0], 0, "damping [N s/m]"), (grid[1, 1], 1, "stiffness [N/m]")):
        for k, r in enumerate(of_paper):
            if r.first.path is not None:
                axis.plot(t, r.first.path[:, i], color=f"C{k}", lw=1, label=f"{r.name}, filtered")
            half = Z_90 * r.first.belief.sd[i]
            axis.errorbar(
                10.3 + 0.3 * k, r.first.belief.mean[i], half, color=f"C{k}", marker="o", ms=3, label=f"{r.name}, 90 %"
            )
        axis.axhline(TRUTH[i], color="k", lw=0.8, ls=":")
        axis.set(xlabel="time [s]", ylabel=name, ylim=TRUTH[i] + np.array([-0.35, 0.35]) * (1 + i))
    grid[0, 0].set(xlabel="time [s]", ylabel="position [m]", title="measured and computed")
    grid[0, 1].set(xlabel="time [s]", ylabel="computed - truth [mm]", title="error against truth")
    for axis in grid.flat:
        axis.legend(fontsize=7)
    figure.suptitle("Estimates of one record (figure 9)")
    paths.append(folder / "spring_mass_damper_estimates.svg")
    figure.savefig(paths[1], metadata={"Date": None})
    return paths


def report(seeds: int = 200, slow_seeds: int = 20, workers: int = 1, quick: bool = False, plots: str = "") -> Texts:
    """The tables; figures 8 and 9 into the folder `plots`, else into a temporary one."""
    seeds, slow_seeds = (20, 1) if quick else (seeds, min(slow_seeds, seeds))
    rows = main(seeds, slow_seeds, workers=workers)
    yield "tables", tables(rows)
    print("\nFigures 8 and 9:", *figures(rows, Path(plots or tempfile.gettempdir())), sep="\n")


if __name__ == "__main__":
    run(report)
