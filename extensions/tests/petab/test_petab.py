"""PEtab files: petab's own linter accepts them, pyPESTO finds our optimum from them, and they come back unchanged."""

import numpy as np
import pytest

from hdt_core.estimation import Belief, NonlinearLeastSquares, unknown
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.model import Param, PhysicsModel, Signal, State
from hdt_petab.formula import Formula, formulas

# petab 0.8 uses what pandas 3 warns will go
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


def cooler(flow_kg_s, conductance_kg_s, lift_k):
    return 100.0 * np.exp(-conductance_kg_s / flow_kg_s) + np.where(flow_kg_s > 2.0, lift_k, 0.0)


STATIC = PhysicsModel(
    name="cooler",
    inputs=(Signal("flow_kg_s", "kg/s"),),
    outputs=(Signal("exit_k", "K", sigma=0.5),),
    params=(
        Param("conductance_kg_s", "kg/s", 1.5, (0.5, 5.0), "design"),
        Param("lift_k", "K", 0.5, (-9.0, 9.0), "design"),
    ),
    equations=cooler,
)
MOVING = PhysicsModel(
    name="van_der_pol",
    inputs=(),
    outputs=(Signal("seen", "-", sigma=0.05),),
    params=(Param("mu", "-", 1.4, (0.01, 20.0), "design"),),
    states=(State("x0", "-", 2.0), State("x1", "-", 0.0)),
    equations=lambda mu, x0, x1: x0 + 0.0 * mu,
    rates=lambda mu, x0, x1: (x1, mu * (1.0 - x0**2) * x1 - x0),
)


def static_record():
    flow = np.linspace(1.0, 3.0, 40)
    clean = STATIC.predict({"conductance_kg_s": 2.0, "lift_k": 1.0}, {"flow_kg_s": flow})["exit_k"]
    return {"flow_kg_s": flow}, {"exit_k": clean + 0.5 * np.random.default_rng(0).standard_normal(40)}


def moving_record():
    clean = MOVING.simulate({"mu": 1.0}, {}, 0.1, n_samples=60)["seen"]
    return {}, {"seen": clean + 0.05 * np.random.default_rng(1).standard_normal(60)}


def test_equations_become_formulas():
    text = formulas(cooler, ["flow_kg_s", "conductance_kg_s"], {"lift_k": 1.0})[0]
    assert text == "((100.0 * exp(((-conductance_kg_s) / flow_kg_s))) + piecewise(1.0, (flow_kg_s > 2.0), 0.0))"


def test_branching_equation_is_no_formula():
    with pytest.raises(TypeError, match="branch on a value"):
        formulas(lambda x: x if x > 0.0 else -x, ["x"], {})


def test_unknown_function_is_no_formula():
    with pytest.raises(TypeError, match="arcsin"):
        np.arcsin(Formula("x"))


def files(tmp_path, model, free, record, **more):
    pytest.importorskip("petab", reason="the extra `petab` is not installed")
    from hdt_petab import write_petab

    return write_petab(tmp_path / model.name, model, free, *record, **more)


PRIOR = Belief(np.array([1.5, 0.5]), np.diag([0.5, 2.0]) ** 2)


@pytest.mark.parametrize(
    ("model", "free", "record", "more"),
    [
        (STATIC, ["conductance_kg_s", "lift_k"], static_record(), {"prior": PRIOR}),
        (STATIC, ["conductance_kg_s"], static_record(), {"prior": unknown(np.array([1.2]))}),
        (MOVING, ["mu"], moving_record(), {"dt_s": 0.1}),
    ],
    ids=["static, prior", "static, nothing known", "dynamic"],
)
def test_round_trip_keeps_question(tmp_path, model, free, record, more):
    path = files(tmp_path, model, free, record, **more)
    from petab.v1 import Problem as Petab
    from petab.v1.lint import lint_problem

    from hdt_petab import read_petab

    assert not lint_problem(Petab.from_yaml(str(path)))
    ours = declared_problem(model, free, *record, **more)
    back = read_petab(path)
    thetas = ours.origin * np.array([[0.9], [1.0], [1.2]])
    np.testing.assert_allclose(back.objective(thetas), ours.objective(thetas), rtol=1e-9)
    one, other = (NonlinearLeastSquares().estimate(p).belief for p in (ours, back))
    np.testing.assert_allclose(one.mean, other.mean, atol=1e-6 * one.sd.min())


def test_pypesto_reproduces_fit(tmp_path):
    """From the files alone: formulas by petab, priors and measurements from its tables, the search by pyPESTO."""
    pypesto = pytest.importorskip("pypesto", reason="pyPESTO is not installed")
    optimize = pytest.importorskip("pypesto.optimize", reason="pyPESTO is not installed")
    import sympy

    record = static_record()
    path = files(tmp_path, STATIC, ["conductance_kg_s", "lift_k"], record, prior=PRIOR)
    from petab.v1 import Problem as Petab
    from petab.v1.calculate import calculate_chi2
    from petab.v1.math import sympify_petab

    petab = Petab.from_yaml(str(path))
    names = list(petab.x_free_ids)
    columns = list(petab.condition_df.columns)
    row = petab.observable_df.iloc[0]
    symbols = [sympy.Symbol(name, real=True) for name in (*columns, *names)]
    outlet = sympy.lambdify(symbols, sympify_petab(row["observableFormula"]), "numpy")
    table = petab.measurement_df
    flows = petab.condition_df.loc[table["simulationConditionId"], columns[0]].to_numpy()
    beliefs = np.array([v.split(";") for v in petab.parameter_df.loc[names, "objectivePriorParameters"]], float)

    def simulated(x):
        return outlet(flows, *x)

    def half_objective(x):
        residuals = (table["measurement"].to_numpy() - simulated(x)) / float(row["noiseFormula"])
        return 0.5 * (residuals @ residuals + np.sum(((x - beliefs[:, 0]) / beliefs[:, 1]) ** 2))

    problem = pypesto.Problem(
        objective=pypesto.Objective(fun=half_objective),
        lb=petab.lb, ub=petab.ub, x_names=names, x_guesses=[petab.parameter_df.loc[names, "nominalValue"].to_numpy()],
    )  # fmt: skip
    optimizer = optimize.ScipyOptimizer("Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13, "maxiter": 4000})
    optimum = optimize.minimize(problem, optimizer=optimizer, n_starts=1, progress_bar=False, filename=None)
    declared = declared_problem(STATIC, ["conductance_kg_s", "lift_k"], *record, prior=PRIOR)
    ours = NonlinearLeastSquares().estimate(declared)
    np.testing.assert_allclose(optimum.optimize_result[0].x, ours.belief.mean, atol=1e-6)
    simulation = table.copy()
    simulation["simulation"] = simulated(ours.belief.mean)
    chi2 = calculate_chi2(table, simulation, petab.observable_df, petab.parameter_df)
    assert chi2 == pytest.approx(ours.fit.chi2, rel=1e-9)


@pytest.mark.parametrize("value", [120.0, -1.0])
def test_nominal_outside_bounds_is_refused(tmp_path, value):
    """A size in another unit is named with file, line and column."""
    path = files(tmp_path, STATIC, ["conductance_kg_s"], static_record())
    from hdt_petab import read_petab

    (table,) = path.parent.glob("*arameters*.tsv")
    header, line = table.read_text().splitlines()
    cells = line.split("\t")
    cells[header.split("\t").index("nominalValue")] = str(value)
    table.write_text("\n".join([header, "\t".join(cells), ""]))

    with pytest.raises(ValueError, match=rf"line 2, nominalValue: conductance_kg_s is {value:g}, outside its bounds"):
        read_petab(path)


def test_correlated_prior_is_refused(tmp_path):
    tilted = Belief(PRIOR.mean, np.array([[0.25, 0.1], [0.1, 4.0]]))
    with pytest.raises(ValueError, match="no correlations"):
        files(tmp_path, STATIC, ["conductance_kg_s", "lift_k"], static_record(), prior=tilted)


def test_changing_inputs_are_refused(tmp_path):
    from hdt_benchmark.spring_mass_damper import SPRING_MASS_DAMPER

    swung = {"force_n": np.sin(np.arange(50.0))}, {"measured_m": np.zeros(50)}
    with pytest.raises(ValueError, match="inputs change"):
        files(tmp_path, SPRING_MASS_DAMPER, ["damping_n_s_m"], swung)
