"""A component whose physics comes as an FMU: FMI 2.0 for model exchange, run by fmpy (the extra `fmi`).

Model exchange shows its states and their rates, which is what a `PhysicsModel` declares: every estimator, filter and
port takes it like any other. A co-simulation FMU hides them, so no filter could step it: export for model exchange.
"""

import re
import shutil
import tempfile
import weakref
from collections.abc import Mapping, Sequence
from ctypes import c_double
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hdt_core.physics.integrators import Solver
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal, State, taking

FATAL = 4
"""Status of a call after which the FMU must not be called again."""


def fmu_model(
    path: str | Path,
    *,
    inputs: Sequence[Signal],
    outputs: Sequence[Signal],
    params: Sequence[Param],
    variables: Mapping[str, str] | None = None,
    losses: Mapping[str, str] | None = None,
    solver: Solver = "adaptive",
) -> PhysicsModel:
    """Declare an FMU as a component.

    Parameters
    ----------
    path : path
        FMI 2.0 with model exchange and a binary for this platform. It is native code: load only what you trust.
    inputs, outputs, params
        As for any `PhysicsModel`: an FMU knows no sensor noise, no role and no drift. States are its own.
    variables : mapping, optional
        Declared name to the FMU's, where they differ: ``{"oil_in_k": "inlet.T"}``.
    losses : mapping, optional
        Health parameter that the FMU does not know, to the declared parameter of which it takes this share:
        ``{"hc_fouling": "hc_ua_w_k"}``.
    solver : str
        As of `PhysicsModel`.

    Raises
    ------
    ImportError
        The extra is not installed.
    ValueError
        The FMU is of another kind, has events, lacks a variable or has it in another role or unit; or a loss is of no
        parameter.

    Notes
    -----
    Equations and rates are evaluated at time 0, point by point. A model with events, whose states jump or whose
    equations change on the way, is refused: no filter here could follow it. A point that the FMU rejects
    is NaN. One instance serves the model, so it is for one thread.
    """
    losses, names = dict(losses or {}), dict(variables or {})
    astray = sorted({*losses, *losses.values()} - {p.name for p in params})
    if astray:
        raise ValueError(f"losses name {', '.join(astray)}, declared as no parameter")
    unit = _Unit(Path(path), names)
    own = [p for p in params if p.name not in losses]
    states = unit.states()
    given: tuple[Signal | Param, ...] = (*inputs, *own)
    unit.check(inputs, ("input",))
    unit.check(own, ("parameter",))
    unit.check(outputs, ("output", "local"))
    order = [*(s.name for s in inputs), *(p.name for p in params), *(s.name for s in states)]

    def run(wanted: str, values: dict[str, Any]) -> tuple[Array, ...]:
        left = {of: values[of] * (1.0 - values[loss]) for loss, of in losses.items()}
        at = {x.name: left.get(x.name, values[x.name]) for x in given}
        asked = [s.name for s in outputs] if wanted == "outputs" else None
        return unit.evaluate(at, [p.name for p in own], [values[s.name] for s in states], asked)

    return PhysicsModel(
        name=unit.name,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        params=tuple(params),
        equations=taking(order, lambda **values: run("outputs", values)),
        states=states,
        rates=taking(order, lambda **values: run("rates", values)) if states else None,
        solver=solver,
    )


def _fmpy() -> ModuleType:
    try:
        import fmpy.fmi2  # noqa: PLC0415
        import fmpy.model_description  # noqa: PLC0415
    except ImportError as missing:
        raise ImportError(
            "an FMU as a component needs fmpy: pip install 'hybrid-digital-twin[fmi]'", name="fmpy"
        ) from missing
    module: ModuleType = fmpy
    return module


class _Unit:
    """An instance of the FMU, set to whatever point is asked for; its folder goes with it."""

    def __init__(self, path: Path, names: Mapping[str, str]) -> None:
        fmpy, self.path, self._names = _fmpy(), path, names
        self._description = _described(fmpy, path)
        self.name = self._description.modelName
        self._variables = {v.name: v for v in self._description.modelVariables if v.type == "Real"}
        folder = tempfile.mkdtemp(prefix="fmu-")
        weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        fmpy.extract(path, folder)
        binary = Path(folder, "binaries", fmpy.platform)
        if not binary.is_dir():
            raise ValueError(f"{path}: no binary for {fmpy.platform}")
        self._rejected = fmpy.fmi1.FMICallException
        self._fmu = fmpy.fmi2.FMU2Model(
            guid=self._description.guid,
            unzipDirectory=folder,
            modelIdentifier=self._description.modelExchange.modelIdentifier,
            instanceName=self.name,
        )
        self._fmu.instantiate()
        weakref.finalize(self, self._fmu.freeInstance)
        self._set_to: tuple[float, ...] | None = None
        self._state_names = [d.variable.derivative.name for d in self._description.derivatives]

    def states(self) -> tuple[State, ...]:
        """States in the FMU's order, under names that Python takes, with the values it starts from."""
        self._initialise((), [])
        held = (c_double * len(self._state_names))()
        if self._state_names:
            self._fmu.getContinuousStates(held, len(held))
        declared = {theirs: ours for ours, theirs in self._names.items()}
        return tuple(
            State(declared.get(n, re.sub(r"\W", "_", n)), self._variables[n].unit or "-", value)
            for n, value in zip(self._state_names, held, strict=True)
        )

    def check(self, declared: Sequence[Signal | Param], causalities: tuple[str, ...]) -> None:
        """Raise ValueError where a declared name is none of the FMU's variables of this kind, or in another unit."""
        for item in declared:
            found = self._variables.get(self._theirs(item.name))
            if found is None or found.causality not in causalities:
                has = sorted(n for n, v in self._variables.items() if v.causality in causalities)
                kinds = " or ".join(causalities)
                raise ValueError(f"{self.path}: {self._theirs(item.name)} is no {kinds}; it has {', '.join(has)}")
            if found.unit is not None and found.unit != item.unit:
                raise ValueError(f"{self.path}: {item.name} is in {found.unit}, declared in {item.unit}")

    def evaluate(
        self, at: Mapping[str, ArrayLike], params: Sequence[str], states: Sequence[ArrayLike], outputs: list[str] | None
    ) -> tuple[Array, ...]:
        """Outputs, or the rates where none are named, broadcast over everything given."""
        names = [n for n in at if n not in params]
        rows = np.broadcast_arrays(*(np.asarray(v, float) for v in (*(at[n] for n in (*params, *names)), *states)))
        shape, points = rows[0].shape, np.stack([r.ravel() for r in rows], axis=1)
        found = np.full((len(points), len(states) if outputs is None else len(outputs)), np.nan)
        first, last = len(params), len(params) + len(names)
        of_params, of_inputs = ([self._reference(n) for n in group] for group in (params, names))
        of_outputs = None if outputs is None else [self._reference(n) for n in outputs]
        for row in np.flatnonzero(np.isfinite(points).all(axis=1)):
            point = points[row].tolist()
            try:
                if self._set_to != tuple(point[:first]):
                    self._initialise(tuple(point[:first]), of_params)
                found[row] = self._read(of_inputs, point[first:last], point[last:], of_outputs)
            except self._rejected as refusal:
                self._set_to = None
                if refusal.status >= FATAL:
                    raise
        return tuple(found.T.reshape(-1, *shape))

    def _initialise(self, values: tuple[float, ...], references: list[int]) -> None:
        """Start anew with these parameters: fixed ones may only be set before initialisation."""
        self._fmu.reset()
        self._fmu.setupExperiment(startTime=0.0)
        if references:
            self._fmu.setReal(references, values)
        self._fmu.enterInitializationMode()
        self._fmu.exitInitializationMode()
        while (found := self._fmu.newDiscreteStates())[0]:
            pass
        if found[4]:
            raise ValueError(f"{self.path}: has an event at {found[5]:g} s; a model with events cannot be stepped here")
        self._fmu.enterContinuousTimeMode()
        self._set_to = values

    def _read(
        self, of_inputs: list[int], inputs: list[float], states: list[float], outputs: list[int] | None
    ) -> list[float]:
        if of_inputs:
            self._fmu.setReal(of_inputs, inputs)
        n = len(states)
        if n:
            self._fmu.setContinuousStates((c_double * n)(*states), n)
        if outputs is not None:
            return list(self._fmu.getReal(outputs))
        rates = (c_double * n)()
        self._fmu.getDerivatives(rates, n)
        return list(rates)

    def _theirs(self, name: str) -> str:
        return self._names.get(name, name)

    def _reference(self, name: str) -> int:
        return int(self._variables[self._theirs(name)].valueReference)


def _described(fmpy: ModuleType, path: Path) -> Any:
    """Model description of an FMU of the kind that serves.

    Raises
    ------
    ValueError
        It is none, or of another kind.
    """
    try:
        description = fmpy.model_description.read_model_description(path)
    except Exception as broken:  # whatever zipfile, lxml and fmpy have to say of the file
        raise ValueError(f"{path}: no FMU: {broken}") from broken
    if description.fmiVersion != "2.0" or description.modelExchange is None:
        kinds = [k for k in ("modelExchange", "coSimulation") if getattr(description, k, None) is not None]
        raise ValueError(f"{path}: FMI {description.fmiVersion}, {' and '.join(kinds)}; needs FMI 2.0, modelExchange")
    if description.numberOfEventIndicators:
        count = description.numberOfEventIndicators
        raise ValueError(f"{path}: has {count} event indicators; a model with events cannot be stepped here")
    return description
