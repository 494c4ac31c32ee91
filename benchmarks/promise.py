"""Does `converged` keep its promise? Every method on problems drawn at random: `python -m benchmarks.promise`.

The best optimum known is the lowest that any method, or least squares from many starts and from the truth's side of
the box, has found. `converged` is kept where the objective lies within 1e-6 of it: a thousandth of a standard
deviation, squared; in the noise's own deviations where residuals show more noise than declared. ``--no-polish`` takes
the methods as they are, without least squares at their end. The problems are stiff, multimodal, rank deficient, misfit,
with missing data, without noise, static and dynamic. ``--write`` puts the table into docs/benchmark.md.
"""

from __future__ import annotations

import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from benchmarks.harness import Texts, markdown, run
from hdt_core.estimation import Belief, Estimate, Estimator, Problem, estimators, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.estimation.descent import descend
from hdt_core.estimation.fit import noise_variance
from hdt_core.estimation.problem import Array
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from hdt_core.robust import Z_90

Trial = tuple[Problem, Array]
"""A problem, and the parameters that made its record (n,); NaN where sigma or the model is not the record's."""
Family = Callable[[np.random.Generator], Trial]
Model = Callable[[Array, Array], Array]


def static(
    rng: np.random.Generator,
    model: Model,
    truth: Array,
    x: Array,
    *,
    sigma: float,
    noise: float = 1.0,
    guess: float = 0.3,
    certain: bool = True,
    bounds: Array | None = None,
) -> Trial:
    """Samples of `model(theta, x)` with noise of `noise` times sigma, from a guess off by `guess` of the truth."""
    spread = guess * np.maximum(np.abs(truth), 1e-12)
    mean = truth + spread * rng.standard_normal(truth.size)
    n = truth.size
    box = np.tile([-np.inf, np.inf], (n, 1)) if bounds is None else bounds
    mean = np.clip(mean, *box.T)
    clean = model(truth, x)
    honest = truth if noise == 1.0 else np.full(n, np.nan)
    problem = Problem(
        names=tuple(f"p{i}" for i in range(n)),
        bounds=box,
        prior=Belief(mean, np.diag(spread**2)) if certain else unknown(mean),
        measured=(clean + noise * sigma * rng.standard_normal(x.size))[:, None],
        sigma=np.array([sigma]),
        observe=lambda _x, theta, i: np.asarray(model(theta, x[i]))[None],
    )
    return problem, honest


def decay(rng: np.random.Generator, *, noise: float = 1.0, certain: bool = True) -> Trial:
    """One exponential."""
    truth = np.array([rng.uniform(1.0, 5.0), rng.uniform(0.2, 2.0)])
    x = np.linspace(0.0, 4.0, 60)
    return static(rng, lambda p, x: p[0] * np.exp(-p[1] * x), truth, x, sigma=0.05, noise=noise, certain=certain)


def near_equal(rng: np.random.Generator) -> Trial:
    """Two exponentials whose rates nearly agree, with nothing known before."""
    rate = rng.uniform(0.5, 1.5)
    truth = np.array([1.0, rate, 1.0, rate * rng.uniform(1.05, 1.6)])
    box = np.tile([0.0, 20.0], (4, 1))
    model: Model = lambda p, x: p[0] * np.exp(-p[1] * x) + p[2] * np.exp(-p[3] * x)  # noqa: E731
    return static(rng, model, truth, np.linspace(0.0, 5.0, 50), sigma=0.02, certain=False, bounds=box)


def wave(rng: np.random.Generator) -> Trial:
    """A sine of unknown frequency: a valley at every alias."""
    truth = np.array([rng.uniform(1.0, 3.0), rng.uniform(2.0, 6.0), rng.uniform(-1.0, 1.0)])
    box = np.array([[0.1, 10.0], [0.5, 12.0], [-3.2, 3.2]])
    model: Model = lambda p, x: p[0] * np.sin(p[1] * x + p[2])  # noqa: E731
    return static(rng, model, truth, np.linspace(0.0, 6.0, 80), sigma=0.1, certain=False, bounds=box)


def bells(rng: np.random.Generator) -> Trial:
    """A peak on a slope, sought from far away."""
    truth = np.array([rng.uniform(2.0, 6.0), rng.uniform(2.0, 8.0), rng.uniform(0.4, 1.2), rng.uniform(-0.3, 0.3)])
    box = np.array([[0.0, 20.0], [0.0, 10.0], [0.1, 5.0], [-2.0, 2.0]])
    model: Model = lambda p, x: p[0] * np.exp(-(((x - p[1]) / p[2]) ** 2)) + p[3] * x  # noqa: E731
    return static(rng, model, truth, np.linspace(0.0, 10.0, 70), sigma=0.1, guess=0.6, certain=False, bounds=box)


def stiff(rng: np.random.Generator) -> Trial:
    """Rates three orders of magnitude apart."""
    truth = np.array([rng.uniform(0.5, 2.0), rng.uniform(200.0, 900.0), rng.uniform(0.5, 2.0), rng.uniform(0.2, 0.9)])
    x = np.concatenate([np.geomspace(1e-4, 1e-2, 40), np.linspace(0.02, 5.0, 40)])
    model: Model = lambda p, x: p[0] * np.exp(-p[1] * x) + p[2] * np.exp(-p[3] * x)  # noqa: E731
    return static(rng, model, truth, x, sigma=0.02)


def scales(rng: np.random.Generator) -> Trial:
    """Parameters twelve orders of magnitude apart."""
    truth = np.array([rng.uniform(1.0, 9.0) * 1e6, rng.uniform(1.0, 9.0) * 1e-6])
    model: Model = lambda p, x: p[0] / (1.0 + p[1] * x)  # noqa: E731
    return static(rng, model, truth, np.linspace(1e4, 1e6, 50), sigma=2e4)


def product(rng: np.random.Generator) -> Trial:
    """Only the product of two parameters is seen."""
    truth = rng.uniform(0.5, 3.0, 2)
    certain = bool(rng.random() < 0.5)
    model: Model = lambda p, x: p[0] * p[1] * (1.0 + 0.1 * x)  # noqa: E731
    box = np.tile([0.05, 20.0], (2, 1))
    return static(rng, model, truth, np.linspace(0.0, 4.0, 40), sigma=0.1, certain=certain, bounds=box)


def misfit(rng: np.random.Generator) -> Trial:
    """A model that lacks a term."""
    (whole, truth), extra = decay(rng), rng.uniform(0.1, 0.6)
    x = np.linspace(0.0, 4.0, 60)
    return replace(whole, measured=whole.measured + (extra * np.sin(3.0 * x))[:, None]), truth * np.nan


def loud(rng: np.random.Generator) -> Trial:
    """Sigma declared three times too small."""
    return decay(rng, noise=3.0, certain=False)


def holed(rng: np.random.Generator) -> Trial:
    """Six values in ten missing."""
    whole, truth = decay(rng) if rng.random() < 0.5 else lag(rng)
    measured = whole.measured.copy()
    measured[rng.random(measured.shape) < 0.6] = np.nan
    return replace(whole, measured=measured), truth


def exact(rng: np.random.Generator) -> Trial:
    """A record without noise."""
    truth = np.array([rng.uniform(1.0, 5.0), rng.uniform(0.2, 2.0), rng.uniform(0.1, 1.0)])
    model: Model = lambda p, x: p[0] * np.exp(-p[1] * x) + p[2]  # noqa: E731
    return static(rng, model, truth, np.linspace(0.0, 6.0, 60), sigma=0.05, noise=0.0, certain=False, guess=0.5)


def dynamic(
    rng: np.random.Generator, step: Callable[..., Array], truth: Array, start: Array, *, n: int, sigma: float
) -> Trial:
    """A record of the first state, prior of 20 % of the truth."""
    sd = 0.2 * np.abs(truth)
    problem = Problem(
        names=tuple(f"p{i}" for i in range(truth.size)),
        bounds=np.column_stack([np.zeros(truth.size), 10.0 * np.abs(truth)]),
        prior=Belief(truth + sd * np.clip(rng.standard_normal(truth.size), -2.0, 2.0), np.diag(sd**2)),
        measured=np.zeros((n, 1)),
        sigma=np.array([sigma]),
        observe=lambda x, _theta, _i: x[:1],
        transition=step,
        start=Belief(start, np.zeros((start.size, start.size))),
    )
    return replace(problem, measured=problem.simulate(truth) + sigma * rng.standard_normal((n, 1))), truth


def lag(rng: np.random.Generator) -> Trial:
    """A first-order lag behind a swinging input."""
    swing = 0.3 + np.sin(np.arange(100) / rng.uniform(4.0, 12.0))
    truth = np.array([rng.uniform(0.5, 3.0), rng.uniform(0.7, 0.95)])
    whole, truth = dynamic(
        rng, lambda x, p, i: p[1] * x + (1.0 - p[1]) * p[0] * swing[i], truth, np.zeros(1), n=100, sigma=0.05
    )
    return replace(whole, bounds=np.array([[0.0, 30.0], [0.0, 0.999]])), truth


def van_der_pol(rng: np.random.Generator) -> Trial:
    """An oscillator that limits itself, by Runge and Kutta."""

    def rates(x: Array, p: Array) -> Array:
        return np.stack(np.broadcast_arrays(x[1], p[0] * (1.0 - x[0] ** 2) * x[1] - x[0]))

    def step(x: Array, p: Array, _i: object) -> Array:
        h = 0.1
        k1 = rates(x, p)
        k2 = rates(x + 0.5 * h * k1, p)
        k3 = rates(x + 0.5 * h * k2, p)
        k4 = rates(x + h * k3, p)
        return np.asarray(x + h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))

    return dynamic(rng, step, np.array([rng.uniform(0.5, 4.0)]), np.array([2.0, 0.0]), n=120, sigma=0.1)


def exchanger(rng: np.random.Generator) -> Trial:
    """The project's own heat exchanger: its conductances from an hour of flight."""
    names = [p.name for p in HEAT_EXCHANGER.free("design")][:2]
    k = 80
    inputs = {
        "hot_flow_kg_s": rng.uniform(0.5, 1.2, k), "ram_flow_kg_s": rng.uniform(0.6, 2.4, k),
        "hot_in_k": rng.uniform(370.0, 430.0, k), "cold_in_k": rng.uniform(225.0, 280.0, k),
    }  # fmt: skip
    inputs = {s.name: inputs.get(s.name, np.zeros(k)) for s in HEAT_EXCHANGER.inputs}
    truth = {p.name: p.nominal * rng.uniform(0.8, 1.2) for p in HEAT_EXCHANGER.params if p.name in names}
    clean = HEAT_EXCHANGER.predict(truth, inputs)
    known = [s for s in HEAT_EXCHANGER.outputs if s.sigma is not None]
    measured = {s.name: clean[s.name] + s.sigma * rng.standard_normal(k) for s in known}
    return declared_problem(HEAT_EXCHANGER, names, inputs, measured), np.array([truth[name] for name in names])


FAMILIES: tuple[Family, ...] = (
    decay, near_equal, wave, bells, stiff, scales, product, misfit, loud, holed, exact, lag, van_der_pol, exchanger,
)  # fmt: skip


def draw_problems(n: int, seed: int = 0) -> list[tuple[str, Problem, Array]]:
    """`n` problems, the families in turn: name, problem, truth."""
    rngs = np.random.default_rng(seed).spawn(n)
    chosen = [FAMILIES[i % len(FAMILIES)] for i in range(n)]
    return [(family.__name__, *family(rng)) for family, rng in zip(chosen, rngs, strict=True)]


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


def report(problems: int = 140, seed: int = 0, no_polish: bool = False, starts: int = STARTS) -> Texts:
    """The table, of the methods as they are or without least squares at their end."""
    methods = [unpolished(e) if no_polish else e for e in estimators().values()]
    result = main(problems, methods, seed, starts)
    for tally in result:
        print(tally.name, *tally.broken, *tally.raised, sep="\n  ")
    yield "methods alone" if no_polish else "promise of converged", table(result, problems, statuses=not no_polish)


if __name__ == "__main__":
    run(report)
