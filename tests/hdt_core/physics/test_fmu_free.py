"""FMUs without inputs: they simulate as fmpy's own solver has it; those with events are refused in words."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest

from hdt_core.estimation import NonlinearLeastSquares, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.fmu import fmu_model
from hdt_core.physics.model import Param, Signal

SOURCE = Path(__file__).parents[2] / "data" / "fmu" / "free_models.c"
CONTINUOUS = {
    "van_der_pol": (1, ("x0", "x1"), Param("mu", "-", 1.0, (0.1, 5.0), "design")),
    "dahlquist": (2, ("x",), Param("k", "-", 1.0, (0.1, 5.0), "design")),
}


def description(name: str, states: tuple[str, ...], constants: tuple[str, ...], indicators: int) -> str:
    start = {"van_der_pol": (2.0, 0.0, 1.0), "dahlquist": (1.0, 1.0)}.get(name, (1.0, 0.0, -9.81, 0.7))
    variables, row = [], '<ScalarVariable name="{}" valueReference="{}" {}><Real {}/></ScalarVariable>'
    for i, state in enumerate(states):
        variables.append(row.format(state, i, 'causality="output" initial="exact"', f'start="{start[i]}"'))
    for i, state in enumerate(states):
        variables.append(row.format(f"der({state})", 2 + i, "", f'derivative="{i + 1}"'))
    for i, constant in enumerate(constants):
        kind = 'causality="parameter" variability="fixed"'
        variables.append(row.format(constant, 4 + i, kind, f'start="{start[len(states) + i]}"'))
    if not states:
        variables.append(row.format("count", 0, 'causality="output"', ""))
    n = len(states)
    outputs = "".join(f'<Unknown index="{i + 1}"/>' for i in range(max(n, 1)))
    rates = "".join(f'<Unknown index="{n + i + 1}"/>' for i in range(n))
    structure = f"<Outputs>{outputs}</Outputs>" + (f"<Derivatives>{rates}</Derivatives>" if n else "")
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="2.0" modelName="{name}" guid="{name}" '
        f'numberOfEventIndicators="{indicators}"><ModelExchange modelIdentifier="{name}"/>'
        f"<ModelVariables>{''.join(variables)}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
        "</fmiModelDescription>"
    )


def built(folder: Path, name: str, number: int, text: str) -> Path:
    fmpy = pytest.importorskip("fmpy", reason="the extra `fmi` is not installed")
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler to build the FMUs of the tests with")
    binary, made = folder / f"{name}.so", folder / f"{name}.fmu"
    headers = Path(fmpy.__file__).parent / "c-code"
    command = [compiler, "-shared", "-fPIC", "-O1", f"-DMODEL={number}", f"-I{headers}", str(SOURCE), "-o", str(binary)]
    subprocess.run(command, check=True, capture_output=True)
    with zipfile.ZipFile(made, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.write(binary, f"binaries/{fmpy.platform}/{name}{fmpy.sharedLibraryExtension}")
    return made


def loaded(folder: Path, name: str):
    number, states, constant = CONTINUOUS[name]
    made = built(folder, name, number, description(name, states, (constant.name,), 0))
    outputs = tuple(Signal(state, "-", sigma=0.01) for state in states)
    return made, fmu_model(made, inputs=(), outputs=outputs, params=(constant,))


@pytest.mark.parametrize("name", CONTINUOUS)
def test_without_inputs_it_simulates_as_fmpy_does(tmp_path, name):
    import fmpy

    made, model = loaded(tmp_path, name)
    seen = model.simulate({}, {}, 0.01, n_samples=1001)
    theirs = fmpy.simulate_fmu(
        str(made), stop_time=10.0, output_interval=0.01, relative_tolerance=1e-9, fmi_type="ModelExchange"
    )
    for output in model.outputs:
        np.testing.assert_allclose(seen[output.name], theirs[output.name][:1001], atol=2e-5)


def test_its_parameter_is_estimated(tmp_path):
    _, model = loaded(tmp_path, "van_der_pol")
    seen = {k: v[:120] for k, v in model.simulate({"mu": 1.5}, {}, 0.05, n_samples=120).items()}
    rng = np.random.default_rng(0)
    measured = {name: values + 0.01 * rng.standard_normal(120) for name, values in seen.items()}
    problem = declared_problem(model, ["mu"], {}, measured, prior=unknown(np.array([1.0])), dt_s=0.05)
    found = NonlinearLeastSquares().estimate(problem)
    assert found.status == "converged"
    assert abs(found.belief.mean[0] - 1.5) < 4.0 * found.belief.sd[0]


def test_a_model_with_events_is_refused(tmp_path):
    ball = description("ball", ("h", "v"), ("g", "e"), 1)
    height = (Signal("h", "-"),)
    with pytest.raises(ValueError, match="1 event indicators; a model with events cannot be stepped"):
        fmu_model(built(tmp_path, "ball", 3, ball), inputs=(), outputs=height, params=())
    stairs = description("stairs", (), (), 0)
    with pytest.raises(ValueError, match="event at 1 s; a model with events cannot be stepped"):
        fmu_model(built(tmp_path, "stairs", 4, stairs), inputs=(), outputs=(Signal("count", "-"),), params=())
