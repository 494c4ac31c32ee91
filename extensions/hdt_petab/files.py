"""Estimation problems as PEtab files, version 1, and back: the format of pyPESTO, AMICI and others (extra `petab`).

What can be written: a declared model whose equations are formulas, without states, every sample a condition; or with
states and inputs that do not change over the record. The prior's standard deviations, not its correlations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from hdt_core.estimation import Belief, Problem
from hdt_core.estimation.declared import declared_problem
from hdt_core.physics.model import Param, PhysicsModel, Signal, State
from hdt_petab.formula import formulas

Array = np.ndarray
NAMES = {"parameter": "parameters.tsv", "condition": "conditions.tsv", "observable": "observables.tsv"}
NAMES |= {"measurement": "measurements.tsv", "sbml": "model.xml"}


def write_petab(
    folder: Path,
    model: PhysicsModel,
    free: Sequence[str],
    inputs: Mapping[str, Array],
    measured: Mapping[str, Array],
    *,
    prior: Belief | None = None,
    dt_s: float = 1.0,
) -> Path:
    """Write the problem that `declared_problem` builds from these arguments as PEtab files.

    Returns
    -------
    Path
        Of problem.yaml.

    Raises
    ------
    ImportError
        The extra is not installed.
    ValueError
        Inputs that change under a model with states, or a prior with correlations.
    TypeError
        Equations that are no formulas.
    """
    frames = _tables(model, free, inputs, measured, prior=prior, dt_s=dt_s)
    folder.mkdir(parents=True, exist_ok=True)
    for kind, rows in frames.items():
        head = list(rows[0])
        lines = ["\t".join(head), *("\t".join(_cell(row[name]) for name in head) for row in rows)]
        (folder / NAMES[kind]).write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / NAMES["sbml"]).write_text(_sbml(model, free), encoding="utf-8")
    files = {f"{kind}_files": [NAMES[kind]] for kind in ("condition", "observable", "measurement", "sbml")}
    content = {"format_version": 1, "parameter_file": NAMES["parameter"], "problems": [files]}
    (folder / "problem.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    return folder / "problem.yaml"


def _tables(
    model: PhysicsModel,
    free: Sequence[str],
    inputs: Mapping[str, Array],
    measured: Mapping[str, Array],
    *,
    prior: Belief | None,
    dt_s: float,
) -> dict[str, list[dict[str, Any]]]:
    params = [next(p for p in model.params if p.name == name) for name in free]
    n = max(len(values) for values in measured.values())
    input_columns = {name: np.broadcast_to(np.asarray(values, float), n) for name, values in inputs.items()}
    if model.states and any(np.ptp(values) > 0.0 for values in input_columns.values()):
        raise ValueError(f"{model.name} has states and its inputs change: PEtab has no table for a record of inputs")
    if prior is not None and np.any(prior.cov[~np.eye(len(params), dtype=bool)]):
        raise ValueError("a PEtab prior has no correlations")
    observables = [s for s in model.outputs if s.name in measured and s.sigma is not None]
    fixed = {p.name: p.nominal for p in model.params if p.name not in free}
    texts = formulas(model.equations, _open(model, free), fixed)
    outputs = dict(zip((s.name for s in model.outputs), texts, strict=True))
    at = range(1) if model.states else range(n)
    return {
        "parameter": [_parameter(p, i, prior) for i, p in enumerate(params)],
        "condition": [{"conditionId": f"c{i}"} | {name: v[i] for name, v in input_columns.items()} for i in at],
        "observable": [
            {"observableId": f"seen_{s.name}", "observableFormula": outputs[s.name], "noiseFormula": s.sigma}
            for s in observables
        ],
        "measurement": [
            {
                "observableId": f"seen_{s.name}",
                "simulationConditionId": "c0" if model.states else f"c{i}",
                "measurement": value,
                "time": i * dt_s if model.states else 0.0,
            }
            for s in observables
            for i, value in enumerate(np.asarray(measured[s.name], float).tolist())
            if not np.isnan(value)
        ],
    }


def _open(model: PhysicsModel, free: Sequence[str]) -> list[str]:
    return [*(s.name for s in model.inputs), *free, *(s.name for s in model.states)]


def _parameter(param: Param, i: int, prior: Belief | None) -> dict[str, Any]:
    row: dict[str, Any] = {"parameterId": param.name, "parameterScale": "lin"}
    row |= {"lowerBound": param.bounds[0], "upperBound": param.bounds[1], "estimate": 1}
    row["nominalValue"] = param.nominal if prior is None else float(np.clip(prior.mean[i], *param.bounds))
    if prior is not None:
        has_prior = np.isfinite(prior.cov[i, i])
        row["objectivePriorType"] = "normal" if has_prior else ""
        moments = f"{float(prior.mean[i])!r};{float(prior.sd[i])!r}"
        row["objectivePriorParameters"] = moments if has_prior else ""
    return row


def _cell(value: Any) -> str:
    return repr(float(value)) if isinstance(value, float) else str(value)


def _libsbml() -> Any:
    try:
        import libsbml
        import petab  # noqa: F401
    except ImportError as missing:
        raise ImportError("PEtab needs the extra: pip install 'hybrid-digital-twin-extensions[petab]'") from missing
    return libsbml


def _sbml(model: PhysicsModel, free: Sequence[str]) -> str:
    """Return SBML with inputs, free parameters, and states under rate rules."""
    libsbml = _libsbml()
    document = libsbml.SBMLDocument(3, 1)
    sbml = document.createModel()
    sbml.setId(model.name)
    nominal = model.nominal
    values = {s.name: 0.0 for s in model.inputs} | {name: nominal[name] for name in free}
    for name, value in (values | {s.name: s.initial for s in model.states}).items():
        parameter = sbml.createParameter()
        parameter.setId(name)
        parameter.setValue(float(value))
        parameter.setConstant(name in values)
    if model.rates is not None:
        fixed = {p.name: p.nominal for p in model.params if p.name not in free}
        texts = formulas(model.rates, _open(model, free), fixed)
        for state, text in zip(model.states, texts, strict=True):
            rule = sbml.createRateRule()
            rule.setVariable(state.name)
            rule.setMath(libsbml.parseL3Formula(text))
    return str(libsbml.writeSBMLToString(document))


def read_petab(path: Path) -> Problem:
    """Read a PEtab problem: formulas of inputs, parameters and states under rate rules.

    Raises
    ------
    ImportError
        The extra is not installed.
    ValueError
        It has what is not read here: reactions, other scales than linear, noise other than normal with a number for
        sigma, other priors, states under several conditions or at times that are not evenly spaced. Or a nominal value
        lies outside its bounds, as one in another unit does.
    """
    _libsbml()
    from petab.v1 import Problem as Petab

    petab = Petab.from_yaml(str(path))
    _check_nominal(petab.parameter_df, path)
    free, prior = _free(petab)
    model = _model(petab, free)
    conditions = list(petab.condition_df.index)
    rows = petab.measurement_df
    times = np.unique(rows["time"].to_numpy(float))
    if model.states and (len(conditions) > 1 or times.size < 2 or np.ptp(np.diff(times)) > 1e-9 * times[-1]):
        raise ValueError(f"{path}: states are read under one condition, at evenly spaced times")
    n = times.size if model.states else len(conditions)
    inputs = {s.name: np.broadcast_to(petab.condition_df[s.name].to_numpy(float), n) for s in model.inputs}
    measured = {s.name: np.full(n, np.nan) for s in model.outputs}
    places = {c: i for i, c in enumerate(conditions)}
    for row in rows.itertuples():
        at = int(np.searchsorted(times, row.time)) if model.states else places[row.simulationConditionId]
        measured[row.observableId][at] = row.measurement
    step = float(times[1] - times[0]) if model.states else 1.0
    return declared_problem(model, [p.name for p in free], inputs, measured, prior=prior, dt_s=step)


def _check_nominal(table: Any, path: Path) -> None:
    """Refuse a nominal value that its own bounds rule out: what is clipped to a bound looks like a fit."""
    for line, row in enumerate(table.reset_index().to_dict("records"), start=2):
        value, low, high = (float(row[name]) for name in ("nominalValue", "lowerBound", "upperBound"))
        if value < low or value > high:
            raise ValueError(
                f"{path}: parameter table, line {line}, nominalValue: {row['parameterId']} is {value:g}, "
                f"outside its bounds {low:g} to {high:g}"
            )


def _free(petab: Any) -> tuple[list[Param], Belief]:
    table = petab.parameter_df
    rows = table[table["estimate"] == 1]
    if (rows["parameterScale"] != "lin").any():
        raise ValueError("only linear parameter scales are read")
    mean = rows["nominalValue"].to_numpy(float).copy()
    sd = np.full(len(rows), np.inf)
    for i, row in enumerate(rows.to_dict("records")):
        kind = row.get("objectivePriorType")
        if isinstance(kind, str) and kind:
            if kind not in ("normal", "parameterScaleNormal"):
                raise ValueError(f"a prior of type {kind} is not read")
            mean[i], sd[i] = map(float, str(row["objectivePriorParameters"]).split(";"))
    params = [
        Param(
            str(name),
            "-",
            float(np.clip(m, row.lowerBound, row.upperBound)),
            (row.lowerBound, row.upperBound),
            "design",
        )
        for name, m, row in zip(rows.index, mean, rows.itertuples(), strict=True)
    ]
    return params, Belief(mean, np.diag(sd**2))


def _model(petab: Any, free: Sequence[Param]) -> PhysicsModel:
    import sympy
    from petab.v1.math import sympify_petab

    libsbml = _libsbml()
    sbml = petab.model.sbml_model
    if sbml.getNumReactions() or sbml.getNumSpecies():
        raise ValueError("reactions and species are not read, only parameters under rate rules")
    rules = {r.getVariable(): libsbml.formulaToL3String(r.getMath()) for r in sbml.getListOfRules() if r.isRate()}
    table = petab.observable_df
    inputs = [c for c in petab.condition_df.columns if c != "conditionName"]
    fixed = {p.getId(): p.getValue() for p in sbml.getListOfParameters()}
    names = [*inputs, *(p.name for p in free), *rules]
    constants = {sympy.Symbol(k, real=True): v for k, v in fixed.items() if k not in names}

    def compiled(texts: Sequence[Any]) -> Any:
        symbols = [sympy.Symbol(name, real=True) for name in names]
        expressions = [sympify_petab(text).subs(constants) for text in texts]
        function = sympy.lambdify(symbols, expressions, "numpy")
        return lambda **values: tuple(function(*(values[name] for name in names)))

    sigmas = [float(sympify_petab(noise)) for noise in table["noiseFormula"]]
    return PhysicsModel(
        name=str(sbml.getId() or "petab"),
        inputs=tuple(Signal(name, "-") for name in inputs),
        outputs=tuple(Signal(str(o), "-", sigma=s) for o, s in zip(table.index, sigmas, strict=True)),
        params=tuple(free),
        equations=compiled(list(table["observableFormula"])),
        states=tuple(State(name, "-", fixed[name]) for name in rules),
        rates=compiled([rules[name] for name in rules]) if rules else None,
    )
