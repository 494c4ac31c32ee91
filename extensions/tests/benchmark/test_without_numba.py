"""A base install has no numba: the same functions run in plain Python, and their answers are those of the compiled."""

import json
import subprocess
import sys

import numpy as np
import pytest

from hdt_benchmark.spring_mass_damper import oscillator_problem
from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares

BLOCKED = """
import json, sys
sys.modules["numba"] = None  # importing it fails, as where it is not installed
from test_without_numba import answers
from hdt_core.estimation.compiled import COMPILED
from hdt_benchmark.spring_mass_damper import oscillator_problem
print(json.dumps({
    "compiled": COMPILED, "kernels": oscillator_problem(0).kernels is not None, "answers": answers(),
}))
"""


def answers():
    """Estimates of every kernel, by the path this process takes."""
    problem = oscillator_problem(0)
    methods = {"nls": NonlinearLeastSquares(), "ekf": ExtendedKalman()}
    return {name: method.estimate(problem).belief.mean.tolist() for name, method in methods.items()}


@pytest.fixture(scope="module")
def without(request):
    """What a process without numba found."""
    folder = str(request.path.parent)
    code = f"import sys; sys.path.insert(0, {folder!r})\n{BLOCKED}"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return json.loads(process.stdout)


def test_plain_python_gives_compiled_answers(without):
    assert not without["compiled"]
    assert not without["kernels"]
    for name, value in answers().items():
        np.testing.assert_allclose(without["answers"][name], value, rtol=1e-6, err_msg=name)
