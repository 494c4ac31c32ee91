"""Numbers certified by NIST: parameters and standard deviations to the digits asked.

Source and licence: tests/data/nist_strd/README.md.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, ParticleSwarm, Problem, unknown

FOLDER = Path(__file__).parents[2] / "data" / "nist_strd"


def _hahn(b, x):
    return (b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3) / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def _enso(b, x):
    turn = 2 * np.pi * x
    return (
        b[0] + b[1] * np.cos(turn / 12) + b[2] * np.sin(turn / 12)
        + b[4] * np.cos(turn / b[3]) + b[5] * np.sin(turn / b[3])
        + b[7] * np.cos(turn / b[6]) + b[8] * np.sin(turn / b[6])
    )  # fmt: skip


def _gauss(b, x):
    bells = b[2] * np.exp(-(((x - b[3]) / b[4]) ** 2)) + b[5] * np.exp(-(((x - b[6]) / b[7]) ** 2))
    return b[0] * np.exp(-b[1] * x) + bells


MODELS = {
    "BoxBOD": lambda b, x: b[0] * (1 - np.exp(-b[1] * x)),
    "Chwirut2": lambda b, x: np.exp(-b[0] * x) / (b[1] + b[2] * x),
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": _enso,
    "Gauss1": _gauss,
    "Hahn1": _hahn,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos3": lambda b, x: b[0] * np.exp(-b[1] * x) + b[2] * np.exp(-b[3] * x) + b[4] * np.exp(-b[5] * x),
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Misra1a": lambda b, x: b[0] * (1 - np.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Rat42": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "Thurber": _hahn,
}


@dataclass(frozen=True)
class Certified:
    name: str
    level: str
    starts: np.ndarray
    values: np.ndarray
    sds: np.ndarray
    sum_of_squares: float
    x: np.ndarray
    y: np.ndarray

    def problem(self, start: int, bounds: np.ndarray | None = None) -> Problem:
        """From start 1 or 2, in units of the response, unbounded unless told."""
        model = MODELS[self.name]
        x = self.x
        free = np.tile([-np.inf, np.inf], (len(self.values), 1))
        return Problem(
            names=tuple(f"b{i + 1}" for i in range(len(self.values))),
            bounds=free if bounds is None else bounds,
            prior=unknown(self.starts[start - 1]),
            measured=self.y[:, None],
            sigma=np.ones(1),
            observe=lambda _states, b, i: model(b, x[i])[None],
        )


def read(name: str) -> Certified:
    lines = (FOLDER / f"{name}.dat").read_text().splitlines()
    number = r"[-+]?\d*\.?\d+(?:[Ee][-+]?\d+)?"
    values = [line.split("=")[1] for line in lines if re.match(r"\s+b\d+ =", line)]
    rows = [[float(v) for v in re.findall(number, value)] for value in values]
    table = np.array(rows)
    squares = next(float(line.split()[-1]) for line in lines if line.startswith("Residual Sum of Squares"))
    level = next(line.split()[0] for line in lines if "Level of Difficulty" in line)
    data = np.array([[float(v) for v in line.split()] for line in lines[60:] if line.strip()])
    return Certified(name, level, table[:, :2].T, table[:, 2], table[:, 3], squares, data[:, 1], data[:, 0])


CERTIFIED = {name: read(name) for name in MODELS}


def digits(estimate, certified):
    """Correct digits of the worst of several numbers, as NIST counts them."""
    return float(-np.log10(max(np.abs(estimate / certified - 1.0).max(), 1e-15)))


@pytest.mark.parametrize("name", CERTIFIED)
def test_least_squares_reaches_certified_digits(name):
    case = CERTIFIED[name]
    estimate = NonlinearLeastSquares().estimate(case.problem(2))
    expected_digits = 6.0 if case.level == "Lower" else 4.0
    assert estimate.status == "converged"
    assert digits(estimate.belief.mean, case.values) >= expected_digits
    assert digits(estimate.fit.scaled_sd, case.sds) >= 4.0
    # residuals contradict the declared sigma of 1: the interval follows the record
    if case.sum_of_squares > 3.0 * len(case.x):
        assert digits(estimate.belief.sd, case.sds) >= 4.0


@pytest.mark.parametrize("sigma", [1e-3, 1.0, 30.0])
@pytest.mark.parametrize("name", CERTIFIED)
def test_converged_holds_for_any_sigma(name, sigma):
    """A sigma declared far too large must not pass a point for the optimum that the record tells from it."""
    case = CERTIFIED[name]
    problem = replace(case.problem(2), sigma=np.full(1, sigma))
    ends = (NonlinearLeastSquares(max_steps=steps).estimate(problem) for steps in (*range(1, 40, 2), 60, 200))
    first = next(estimate for estimate in ends if estimate.status == "converged")
    assert (np.abs(first.belief.mean - case.values) < 2e-3 * case.sds + 1e-9 * np.abs(case.values)).all()


@pytest.mark.parametrize("name", [name for name, case in CERTIFIED.items() if case.level != "Higher"])
def test_far_start_reaches_certified_digits(name):
    case = CERTIFIED[name]
    estimate = NonlinearLeastSquares(max_steps=1000).estimate(case.problem(1))
    assert digits(estimate.belief.mean, case.values) >= (6.0 if case.level == "Lower" else 4.0)


@pytest.mark.parametrize("name", ["BoxBOD", "MGH10"])
def test_failed_far_start_is_reported(name):
    estimate = NonlinearLeastSquares().estimate(CERTIFIED[name].problem(1))
    assert estimate.status in ("not_identifiable", "max_steps")


def test_filter_names_better_optimum():
    case = CERTIFIED["ENSO"]
    noise_sd = np.sqrt(case.sum_of_squares / (len(case.x) - len(case.values)))
    problem = replace(case.problem(2), sigma=np.array([noise_sd]))

    estimate = ExtendedKalman().estimate(problem)

    assert estimate.status == "local_optimum"
    assert (np.abs(estimate.better - case.values) < 1e-3 * case.sds).all()


WIDE = {
    "Misra1a": [(1.0, 1000.0), (1e-5, 1e-2)],
    "BoxBOD": [(1.0, 1000.0), (0.01, 10.0)],
    "Chwirut2": [(0.0, 1.0), (0.0, 0.1), (0.0, 0.1)],
    "DanWood": [(0.01, 10.0), (0.1, 10.0)],
    "Rat42": [(1.0, 500.0), (0.0, 10.0), (0.0, 1.0)],
    "MGH09": [(0.0, 10.0), (0.0, 10.0), (0.0, 10.0), (0.0, 10.0)],
    "Misra1c": [(10.0, 2000.0), (1e-5, 1e-2)],
    "MGH17": [(0.0, 10.0), (0.0, 10.0), (-10.0, 0.0), (0.001, 0.1), (0.001, 0.1)],
}


@pytest.mark.parametrize("name", WIDE)
def test_swarm_reaches_certified_residuals(name):
    case = CERTIFIED[name]
    problem = case.problem(1, bounds=np.array(WIDE[name]))
    estimate = ParticleSwarm(n_particles=60, n_iterations=200).estimate(problem)
    assert problem.chi2(estimate.belief.mean[None])[0] == pytest.approx(case.sum_of_squares, rel=1e-8)
