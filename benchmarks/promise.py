"""Does `converged` keep its promise? Every method on problems drawn at random: `python -m benchmarks.promise`.

The best optimum known is the lowest that any method, or least squares from many starts and from the truth's side of
the box, has found. `converged` is kept where the objective lies within 1e-6 of it: a thousandth of a standard
deviation, squared; in the noise's own deviations where residuals show more noise than declared. ``--polish no`` takes
the methods as they are, without least squares at their end. ``--write`` puts the table into docs/benchmark.md.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.harness import Texts, markdown, run
from benchmarks.random_problems import draw_problems
from hdt_core.estimation import Estimate, Estimator, Problem, estimators
from hdt_core.estimation.descent import descend
from hdt_core.estimation.fit import noise_variance
from hdt_core.robust import Z_90

NEAR = 1e-3  # standard deviations
STARTS = 24


@dataclass(slots=True)
class Tally:
    """One method over all problems."""

    name: str
    statuses: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)  # `converged`, but away from the best
    raised: list[str] = field(default_factory=list)
    at_best: int = 0
    covered: list[bool] = field(default_factory=list)  # parameters within the 90 % interval
    seconds: float = 0.0
    n_evals: int = 0


def best_objective(problem: Problem, estimates: Sequence[Estimate], n_starts: int = STARTS) -> float:
    """Lowest objective that anyone knows."""
    lower, upper = problem.search_box
    rng = np.random.default_rng(0)
    starts = [problem.origin, *(e.belief.mean for e in estimates)]
    starts += list(lower + (upper - lower) * rng.random((n_starts, lower.size)))
    ends = [descend(problem, np.clip(s, *problem.bounds.T), 100).objective for s in starts if np.isfinite(s).all()]
    return float(min(ends))


def unpolished(estimator: Estimator) -> Estimator:
    """The method alone."""
    return replace(estimator, polish=False) if hasattr(estimator, "polish") else estimator  # type: ignore[type-var]


def main(n: int, methods: Sequence[Estimator], seed: int = 0, starts: int = STARTS) -> list[Tally]:
    """Every estimator on `n` problems."""
    tallies = [Tally(e.name) for e in methods]
    for i, (family, problem, truth) in enumerate(draw_problems(n, seed)):
        estimates: list[tuple[Tally, Estimate]] = []
        for estimator, tally in zip(methods, tallies, strict=True):
            started = time.process_time()
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error")
                    estimates.append((tally, estimator.estimate(problem)))
            except Exception as raised:  # what must never happen is counted
                tally.raised.append(f"{family} {i}: {raised!r}")
            tally.seconds += time.process_time() - started
        best = best_objective(problem, [e for _, e in estimates], starts)
        free = int(np.count_nonzero(np.ptp(problem.bounds, axis=1) > 0.0))
        allowed = NEAR**2 * max(noise_variance(best, problem.n_values, free), 1.0)
        for tally, estimate in estimates:
            tally.statuses[estimate.status] += 1
            tally.n_evals += estimate.n_evals + estimate.n_checks
            above = float(problem.objective(estimate.belief.mean[None])[0]) - best
            tally.at_best += above <= allowed
            if estimate.status not in ("diverged", "not_identifiable") and np.isfinite(truth).all():
                tally.covered += (np.abs(estimate.belief.mean - truth) < Z_90 * estimate.belief.sd).tolist()
            if estimate.status == "converged" and above > allowed:
                tally.broken.append(f"{family} {i}: {above:.3g}")
    return tallies


def table(tallies: Sequence[Tally], n: int, *, statuses: bool) -> str:
    """Markdown; with `statuses`, how often each method ended otherwise."""
    columns = ["method", "at the best", "`converged`", "kept", "other statuses", "coverage of 90 %"]
    lines = [[*columns, "passes", "CPU [s]"]]
    for t in tallies:
        claims = t.statuses["converged"]
        upheld = f"{100.0 * (1.0 - len(t.broken) / claims):.1f} %" if claims else "-"
        others = ", ".join(f"{v} `{k}`" for k, v in t.statuses.most_common() if k != "converged")
        coverage = f"{np.mean(t.covered):.2f}" if t.covered else "-"
        cells = [f"{t.at_best} of {n}", f"{claims}", upheld, others, coverage]
        lines.append([t.name, *cells, f"{t.n_evals / n:.0f}", f"{t.seconds / n:.2f}"])
    if not statuses:
        lines = [line[:4] + line[5:] for line in lines]
    return f"{markdown(lines)}\n\nExceptions: {sum(len(t.raised) for t in tallies)}."


def report(problems: int = 140, seed: int = 0, only: tuple[str, ...] = (), no_polish: bool = False) -> Texts:
    """The table, of some methods by name, or of all without least squares at their end."""
    chosen = [e for e in estimators().values() if not only or e.name in only]
    result = main(problems, [unpolished(e) for e in chosen] if no_polish else chosen, seed)
    for tally in result:
        print(tally.name, *tally.broken, *tally.raised, sep="\n  ")
    yield "methods alone" if no_polish else "promise of converged", table(result, problems, statuses=not no_polish)


if __name__ == "__main__":
    run(report)
