"""A base install has no numba: the same functions run in plain Python, and their answers are those of the compiled."""

import json
import subprocess
import sys

import numpy as np
import pytest

from hdt_benchmark.exchanger import ExchangerSamples, fit_conductance_scale, fit_lumped_log
from hdt_benchmark.oscillator import oscillator_problem
from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares

BLOCKED = """
import json, sys
sys.modules["numba"] = None  # importing it fails, as where it is not installed
from test_without_numba import answers
from hdt_core.estimation.compiled import COMPILED
from hdt_benchmark.oscillator import oscillator_problem
print(json.dumps({
    "compiled": COMPILED, "kernels": oscillator_problem(0).kernels is not None, "answers": answers(),
}))
"""


def samples():
    """Three flights of eight samples."""
    rng, n = np.random.default_rng(4), 24
    hot, ram = 0.9 + 0.02 * rng.normal(size=n), 1.6 + 0.1 * rng.normal(size=n)
    hot_out = 310.0 + rng.normal(size=n)
    starts = np.array([0, 8, 16, 24])
    return ExchangerSamples(hot, ram, np.full(n, 390.0), hot_out, np.full(n, 250.0), np.full(n, 4.0), starts)


def answers():
    """Estimates of every kernel, by the path this process takes."""
    flights, problem = samples(), oscillator_problem(0)
    estimates = {
        "conductance": fit_conductance_scale(flights, np.full(24, 1500.0)).mean,
        "log": fit_lumped_log(flights, 1.0, 8.0, 8.0).mean,
        "nls": NonlinearLeastSquares().estimate(problem).belief.mean,
        "ekf": ExtendedKalman().estimate(problem).belief.mean,
    }
    return {name: value.tolist() for name, value in estimates.items()}


@pytest.fixture(scope="module")
def without(request):
    """What a process without numba found."""
    folder = str(request.path.parent)
    code = f"import sys; sys.path.insert(0, {folder!r})\n{BLOCKED}"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(process.stdout)


def test_nothing_is_compiled(without):
    assert not without["compiled"]
    assert not without["kernels"]


def test_answers_are_those_of_the_compiled_path(without):
    for name, value in answers().items():
        np.testing.assert_allclose(without["answers"][name], value, rtol=1e-6, err_msg=name)
