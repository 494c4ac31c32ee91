"""An FMU with events as a component: its outputs over time, run from the start through every event.

Between two events its equations hold; at one they change, its states may jump, and what it remembers beside them moves
on unseen. So no filter can be put into its middle. What can be declared is the whole run: outputs as a function of time
and parameters, which methods that fit a whole record take like any other.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from hdt_core.physics.integrators import RTOL
from hdt_core.physics.model import Array, Param, PhysicsModel, Signal
from hdt_fmi.fmu_unit import FATAL, FmuUnit, apply_losses, check_losses

TIME = Signal("time_s", "s")
MOST_EVENTS = 10_000
"""In one run: a ball that bounces ever faster has no end."""
SAME_TIME = 1e-12
"""Share of the time run, and seconds in the first: instants closer than that are one."""
STEPS_A_RUN = 50
"""The solver looks for events at least so often in a run, as fmpy's own simulation does."""


def fmu_over_time(
    path: str | Path,
    *,
    outputs: Sequence[Signal],
    params: Sequence[Param],
    variables: Mapping[str, str] | None = None,
    losses: Mapping[str, str] | None = None,
) -> PhysicsModel:
    """Declare an FMU without inputs, with events or without, as a component whose only input is `time_s`.

    Parameters
    ----------
    path, params, variables, losses
        As of `fmu.fmu_model`.
    outputs : sequence of Signal
        Real or whole numbers of the FMU.

    Returns
    -------
    PhysicsModel
        Ask it for all instants at once: ``model.predict({}, {"time_s": time_s})``. One run from time 0 serves them.

    Raises
    ------
    ImportError, ValueError
        As of `fmu.fmu_model`; the FMU has inputs.

    Notes
    -----
    SUNDIALS' CVODE steps and finds state events to a tolerance of 1e-8; at an instant with an event the outputs are
    those after it. NaN after the FMU has ended the simulation, rejected a point or had more than 10,000 events. A
    filter asks instant by instant, and each is a run of its own.
    """
    losses = dict(losses or {})
    check_losses(losses, params)
    unit = FmuUnit(path, dict(variables or {}))
    driven = sorted(v.name for v in unit.variables.values() if v.causality == "input")
    if driven:
        raise ValueError(f"{unit.path}: has inputs ({', '.join(driven)}); a run over time takes none")
    own = [p for p in params if p.name not in losses]
    unit.check(own, ("parameter",))
    unit.check(outputs, ("output", "local"), ("Real", "Integer"))
    run = _Run(unit, [unit.reference(p.name) for p in own], [unit.fmu_name(s.name) for s in outputs])

    def over_time(**values: Any) -> tuple[Array, ...]:
        time_s = values.pop(TIME.name)
        effective = apply_losses(values, losses)
        return run.evaluate([effective[p.name] for p in own], time_s)

    return PhysicsModel(unit.name, (TIME,), tuple(outputs), tuple(params), over_time)


class _Run:
    """Run one instance, restarted for each parameter set."""

    def __init__(self, unit: FmuUnit, params: list[int], outputs: list[str]) -> None:
        from fmpy.sundials import CVodeSolver  # with the extra `fmi` only

        self.unit = unit
        self._params = params
        self._solver_of = CVodeSolver
        self._outputs = [unit.variables[name] for name in outputs]
        self._refusal: Exception | None = None

    def evaluate(self, params: Sequence[Any], time_s: Any) -> tuple[Array, ...]:
        """Return outputs at every parameter set and instant, broadcast."""
        rows = np.broadcast_arrays(*(np.asarray(v, float) for v in (*params, time_s)))
        shape = rows[0].shape
        points = np.stack([r.ravel() for r in rows], axis=1)
        results = np.full((len(points), len(self._outputs)), np.nan)
        valid = np.flatnonzero(np.isfinite(points).all(axis=1) & (points[:, -1] >= 0.0))
        sets, member = np.unique(points[valid, :-1], axis=0, return_inverse=True)
        for k, values in enumerate(sets):
            of_set = valid[member.ravel() == k]
            instants, back = np.unique(points[of_set, -1], return_inverse=True)
            results[of_set] = self._run(values.tolist(), instants)[back]
        return tuple(results.T.reshape(-1, *shape))

    def _run(self, values: list[float], instants: Array) -> Array:
        """Return outputs at these instants, (k, outputs); NaN after the run ends."""
        results = np.full((len(instants), len(self._outputs)), np.nan)
        try:
            due_s = self.unit.begin(self._params, values)
            journey = _Journey(self.unit, self._solver(float(instants[-1])), due_s)
            for k, instant in enumerate(instants):
                if not journey.reach(float(instant)):
                    break
                if self._refusal is not None:
                    raise self._refusal
                results[k] = [self._read(v) for v in self._outputs]
        except self.unit.rejected as refusal:
            if refusal.status >= FATAL:
                raise
        except RuntimeError:  # the solver's: no step is short enough
            pass
        return results

    def _read(self, variable: Any) -> float:
        get = self.unit.fmu.getReal if variable.type == "Real" else self.unit.fmu.getInteger
        return float(get([variable.valueReference])[0])

    def _solver(self, end_s: float) -> Any:
        fmu = self.unit.fmu
        description = self.unit.description
        self._refusal = None
        return self._solver_of(
            nx=description.numberOfContinuousStates,
            nz=description.numberOfEventIndicators,
            get_x=fmu.getContinuousStates,
            set_x=self._guarded(fmu.setContinuousStates),
            get_dx=self._guarded(fmu.getDerivatives),
            get_z=self._guarded(fmu.getEventIndicators),
            get_nominals=fmu.getNominalsOfContinuousStates,
            set_time=self._guarded(fmu.setTime),
            input=SimpleNamespace(apply=lambda _time: None),
            startTime=0.0,
            maxStep=max(end_s, 1.0) / STEPS_A_RUN,
            relativeTolerance=RTOL,
        )

    def _guarded(self, call: Callable[..., object]) -> Callable[..., None]:
        """Wrap a callback: exceptions cannot pass through C, so store them for the caller."""

        def wrapper(*arguments: Any) -> None:
            try:
                call(*arguments)
            except self.unit.rejected as refusal:
                self._refusal = refusal

        return wrapper


class _Journey:
    """State of a running simulation: its time and its next time event."""

    def __init__(self, unit: FmuUnit, solver: Any, due_s: float) -> None:
        self.unit = unit
        self._solver = solver
        self._now_s = 0.0
        self._due_s = due_s
        self._events = 0

    def reach(self, instant_s: float) -> bool:
        """Advance to an instant through all events; False where the run ended earlier."""
        while self._events <= MOST_EVENTS and not np.isnan(self._due_s):
            soon_s = self._now_s + SAME_TIME * max(1.0, self._now_s)
            if self._due_s <= soon_s:
                self._event()
            elif instant_s <= soon_s:
                return True
            else:
                self._step(min(instant_s, self._due_s))
        return False

    def _step(self, to_s: float) -> None:
        is_event, _, self._now_s = self._solver.step(self._now_s, to_s)
        self.unit.fmu.setTime(self._now_s)
        needs_event = False
        is_over = False
        if self.unit.description.modelExchange.needsCompletedIntegratorStep:
            needs_event, is_over = self.unit.fmu.completedIntegratorStep()
        if is_over:
            self._due_s = np.nan
        elif is_event or needs_event:
            self._event()

    def _event(self) -> None:
        self._events += 1
        self.unit.fmu.enterEventMode()
        self._due_s = self.unit.settle()
        self._solver.reset(self._now_s)
