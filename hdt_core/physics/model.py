"""How a physics model is declared: once, in one place, for every estimator, check and table that reads it."""

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hdt_core.physics.integrators import Solver, advanced

Array = NDArray[np.float64]  # complex128 passes through too, where a derivative is taken by complex step
Role = Literal["design", "health"]
Equation = Callable[..., Any]


@dataclass(frozen=True, slots=True)
class Signal:
    """What goes in or comes out: name (it ends in its unit), unit, and the sensor's errors if it has one.

    `sigma` is the standard deviation of its noise; `bias_sd` and `gain_sd` those of its calibration, one draw an
    installation: a constant in the signal's unit, and a share of the value.
    """

    name: str
    unit: str
    sigma: float | None = None
    bias_sd: float | None = None
    gain_sd: float | None = None

    def named(self, name: str) -> "Signal":
        """The same signal under the name that a record or another model has for it."""
        return replace(self, name=name)


@dataclass(frozen=True, slots=True)
class Param:
    """A constant of the component.

    `role` is the only switch between calibrating the digital system model (free `design`) and tracking the twin
    (free `health`). A health parameter is a loss: 0 as built, larger is worse. `drift` is the standard deviation
    it may gain per square root of a flight, `unit_sd` how far units as made, sensors and all, lie from the fleet's: so
    much of a loss may be how a unit was built. `sd` of a design parameter is how far one aircraft may be from nominal,
    where that is known before any flight.
    """

    name: str
    unit: str
    nominal: float
    bounds: tuple[float, float]
    role: Role
    drift: float = 0.0
    sd: float | None = None
    unit_sd: float | None = None

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low <= self.nominal <= high:
            raise ValueError(f"{self.name}: nominal {self.nominal} is outside its bounds {self.bounds}")
        if self.drift < 0.0:
            raise ValueError(f"{self.name}: drift {self.drift} is negative")
        if self.sd is not None and not self.sd > 0.0:
            raise ValueError(f"{self.name}: a standard deviation of {self.sd} is none")
        if self.role == "health" and (self.nominal < 0.0 or low >= 0.0):
            raise ValueError(f"{self.name}: a loss is 0 or more as declared, and its lower bound lies below 0")

    def known_to(self, *, sd: float) -> "Param":
        """The same parameter with what is known of it before any flight."""
        return replace(self, sd=sd)

    def in_ln(self, name: str, *, sd: float) -> "Param":
        """The natural logarithm of the parameter, for what must stay positive; `sd` is the logarithm's."""
        low, high = map(math.log, self.bounds)
        return Param(name, f"ln {self.unit}", float(np.log(self.nominal)), (low, high), self.role, sd=sd)


@dataclass(frozen=True, slots=True)
class State:
    """What the component remembers from one instant to the next, and its value at the start."""

    name: str
    unit: str
    initial: float


@dataclass(frozen=True, slots=True)
class PhysicsModel:
    """Inputs, outputs, parameters, states and the equations between them.

    Attributes
    ----------
    equations : callable
        Pure and vectorised. Argument names are exactly the declared inputs, parameters and states; returns one array
        an output, in the declared order (the array itself where there is one output).
    rates : callable, optional
        Same argument names; returns the time derivative of each state, in the declared order. Needed with states.
    step : callable, optional
        Same argument names and `dt_s`; returns each state one step later with the inputs held. The solver's where
        absent.
    solver : str
        How states advance without a `step`: `adaptive`, with the error watched; `rk4`; or `euler`, by name only.
    """

    name: str
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    params: tuple[Param, ...]
    equations: Equation
    states: tuple[State, ...] = ()
    rates: Equation | None = None
    step: Equation | None = None
    solver: Solver = "adaptive"

    def __post_init__(self) -> None:
        names = self.names
        doubled = sorted({n for n in names if names.count(n) > 1})
        if doubled:
            raise ValueError(f"{self.name}: declared twice: {', '.join(doubled)}")
        for function, more in ((self.equations, set()), (self.rates, set()), (self.step, {"dt_s"})):
            if function is not None and set(inspect.signature(function).parameters) != set(names) | more:
                off = set(inspect.signature(function).parameters) ^ (set(names) | more)
                raise ValueError(f"{self.name}: declared and taken names differ in {', '.join(sorted(off))}")
        if bool(self.states) != (self.rates is not None):
            raise ValueError(f"{self.name}: states and rates come together or not at all")

    @property
    def names(self) -> tuple[str, ...]:
        """Every argument of the equations: inputs, parameters, states."""
        return tuple(x.name for group in (self.inputs, self.params, self.states) for x in group)

    def signal(self, name: str) -> Signal:
        """The declared input or output of this name."""
        return next(s for s in (*self.inputs, *self.outputs) if s.name == name)

    @property
    def sigmas(self) -> Array:
        """Sensor standard deviation of each output; infinite where no sensor is declared. (n_outputs,)"""
        return np.array([np.inf if s.sigma is None else s.sigma for s in self.outputs])

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal value of every parameter, by name."""
        return {p.name: p.nominal for p in self.params}

    def free(self, role: Role) -> tuple[Param, ...]:
        """Return the parameters of a role: `design` to calibrate, `health` to track."""
        return tuple(p for p in self.params if p.role == role)

    def param(self, name: str) -> Param:
        """The declared parameter of this name."""
        return next(p for p in self.params if p.name == name)

    def bounds(self, role: Role | None = None) -> Array:
        """Lower and upper bound of each parameter (of a role). (n, 2)"""
        chosen = self.params if role is None else self.free(role)
        return np.array([p.bounds for p in chosen]).reshape(-1, 2)

    def calibrated(self, values: Mapping[str, float]) -> "PhysicsModel":
        """Return the same model with these parameters' nominal values: how a calibration becomes a declaration."""
        unknown = sorted(set(values) - set(self.nominal))
        if unknown:
            raise KeyError(f"{self.name} has no parameter {', '.join(unknown)}")
        return replace(self, params=tuple(replace(p, nominal=values.get(p.name, p.nominal)) for p in self.params))

    def predict(
        self,
        params: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike],
        states: Mapping[str, ArrayLike] | None = None,
    ) -> dict[str, Array]:
        """Outputs by name, broadcast over parameters, inputs and states.

        Parameters not given take their nominal value; states not given their initial value.
        """
        return dict(
            zip(
                (s.name for s in self.outputs),
                as_tuple(self.equations(**self._values(params, inputs, states))),
                strict=True,
            )
        )

    def advance(
        self,
        params: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike],
        states: Mapping[str, ArrayLike],
        dt_s: float,
    ) -> dict[str, Array]:
        """States one step later, the inputs held over the step."""
        values = self._values(params, inputs, states)
        names = [s.name for s in self.states]
        if self.step is not None:
            return dict(zip(names, as_tuple(self.step(**values, dt_s=dt_s)), strict=True))
        if self.rates is None:
            return {}
        shape = np.broadcast_shapes(*(v.shape for v in values.values()))
        now = np.stack([np.broadcast_to(values[name], shape) for name in names])

        def rates(x: Array) -> Array:
            assert self.rates is not None
            found = as_tuple(self.rates(**(values | dict(zip(names, x, strict=True)))))
            return np.stack([np.broadcast_to(rate, shape) for rate in found])

        return dict(zip(names, advanced(rates, now, dt_s, self.solver), strict=True))

    def simulate(
        self,
        params: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike],
        dt_s: float,
        states: Mapping[str, ArrayLike] | None = None,
        n_samples: int | None = None,
    ) -> dict[str, Array]:
        """Outputs over time; inputs are (n_samples, ...), the first axis is time, and so are the outputs.

        Sample k is computed from the states at k; the states at k + 1 follow from the inputs held at k. `n_samples`
        says how many where no input does.

        Raises
        ------
        ValueError
            Neither an input nor `n_samples` says how many.
        """
        held = {name: np.asarray(value) for name, value in inputs.items()}
        told = [len(v) for v in held.values() if v.ndim]
        if n_samples is None and not told:
            raise ValueError(f"{self.name}: no input over time; say n_samples")
        n_samples = max(told) if n_samples is None else n_samples
        now: dict[str, Any] = {s.name: s.initial for s in self.states} | dict(states or {})
        rows: list[dict[str, Array]] = []
        for k in range(n_samples):
            at_k = {name: value[k] if value.ndim else value for name, value in held.items()}
            rows.append(self.predict(params, at_k, now))
            if k + 1 < n_samples:
                now = dict(self.advance(params, at_k, now, dt_s))
        return {s.name: np.array([row[s.name] for row in rows]) for s in self.outputs}

    def _values(
        self, params: Mapping[str, ArrayLike], inputs: Mapping[str, ArrayLike], states: Mapping[str, ArrayLike] | None
    ) -> dict[str, Array]:
        initial = {s.name: s.initial for s in self.states}
        given: dict[str, Any] = self.nominal | initial | dict(params) | dict(inputs) | dict(states or {})
        missing = [n for n in self.names if n not in given]
        if missing:
            raise KeyError(f"{self.name} needs {', '.join(missing)}")
        return {name: np.asarray(given[name]) for name in self.names}


def declared(value: float | None) -> float:
    """A number that a declaration may leave out and that is needed here.

    Raises
    ------
    ValueError
        It is left out.
    """
    if value is None:
        raise ValueError("the declaration leaves out a number that is needed")
    return value


def as_tuple(value: Any) -> tuple[Any, ...]:
    """Return what equations gave, one array or several, as a tuple."""
    return tuple(value) if isinstance(value, (tuple, list)) else (value,)


def taking(names: Sequence[str], function: Equation) -> Equation:
    """Give a function of ``**values`` the signature that a declaration is checked against."""
    keyword_only = inspect.Parameter.KEYWORD_ONLY
    signature = inspect.Signature([inspect.Parameter(n, keyword_only) for n in names])
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function
