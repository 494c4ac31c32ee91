"""A component whose physics comes as an FMU: FMI 2.0 for model exchange, run by fmpy (the extra `fmi`).

Model exchange shows its states and their rates, which is what a `PhysicsModel` declares: every estimator, filter and
port takes it like any other. A co-simulation FMU hides them, so no filter could step it: export for model exchange.
A model with events is `fmu_events.fmu_over_time`'s.
"""

from collections.abc import Mapping, Sequence
from ctypes import c_double
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hdt_core.physics.integrators import Solver
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal
from hdt_fmi.fmu_unit import FATAL, FmuUnit, apply_losses, check_losses


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
    Equations and rates are evaluated at time 0, point by point. A point that the FMU rejects is NaN. One instance
    serves the model, so it is for one thread.
    """
    losses = dict(losses or {})
    check_losses(losses, params)
    points = _Points(FmuUnit(path, dict(variables or {})))
    own = [p for p in params if p.name not in losses]
    unit = points.unit
    states = points.unit.states()
    unit.check(inputs, ("input",))
    unit.check(own, ("parameter",))
    unit.check(outputs, ("output", "local"))

    def run(kind: str, values: dict[str, Any]) -> tuple[Array, ...]:
        now = [values.pop(s.name) for s in states]
        output_names = [s.name for s in outputs] if kind == "outputs" else None
        return points.evaluate(apply_losses(values, losses), [p.name for p in own], now, output_names)

    return PhysicsModel(
        name=unit.name,
        inputs=tuple(inputs),
        outputs=tuple(outputs),
        params=tuple(params),
        equations=lambda **values: run("outputs", values),
        states=states,
        rates=(lambda **values: run("rates", values)) if states else None,
        solver=solver,
    )


class _Points:
    """Evaluate an FMU at arbitrary points."""

    def __init__(self, unit: FmuUnit) -> None:
        self.unit = unit
        self._set_to: tuple[float, ...] | None = None
        events = unit.description.numberOfEventIndicators
        due_s = unit.begin([], ())
        if events or due_s != np.inf:
            what = f"{events} event indicators" if events else f"an event at {due_s:g} s"
            raise ValueError(f"{unit.path}: has {what}; declare a model with events by fmu_over_time")

    def evaluate(
        self, at: Mapping[str, ArrayLike], params: Sequence[str], states: Sequence[ArrayLike], outputs: list[str] | None
    ) -> tuple[Array, ...]:
        """Return outputs, or rates where no output is named, broadcast over all arguments."""
        names = [n for n in at if n not in params]
        rows = np.broadcast_arrays(*(np.asarray(v, float) for v in (*(at[n] for n in (*params, *names)), *states)))
        shape = rows[0].shape
        points = np.stack([r.ravel() for r in rows], axis=1)
        results = np.full((len(points), len(states) if outputs is None else len(outputs)), np.nan)
        first = len(params)
        last = len(params) + len(names)
        of_params, of_inputs = ([self.unit.reference(n) for n in group] for group in (params, names))
        of_outputs = None if outputs is None else [self.unit.reference(n) for n in outputs]
        for row in np.flatnonzero(np.isfinite(points).all(axis=1)):
            point = points[row].tolist()
            try:
                if self._set_to != tuple(point[:first]):
                    self.unit.begin(of_params, point[:first])
                    self._set_to = tuple(point[:first])
                results[row] = self._read(of_inputs, point[first:last], point[last:], of_outputs)
            except self.unit.rejected as refusal:
                self._set_to = None
                if refusal.status >= FATAL:
                    raise
        return tuple(results.T.reshape(-1, *shape))

    def _read(
        self, of_inputs: list[int], inputs: list[float], states: list[float], outputs: list[int] | None
    ) -> list[float]:
        if of_inputs:
            self.unit.fmu.setReal(of_inputs, inputs)
        n = len(states)
        if n:
            self.unit.fmu.setContinuousStates((c_double * n)(*states), n)
        if outputs is not None:
            return list(self.unit.fmu.getReal(outputs))
        rates = (c_double * n)()
        self.unit.fmu.getDerivatives(rates, n)
        return list(rates)
