"""Declaration of a physics model, read by every estimator, check and table."""

import inspect
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hdt_core.physics.integrators import Solver, advance_states

Array = NDArray[np.float64]  # complex128 passes through too, where a derivative is taken by complex step
Role = Literal["design", "health"]
Equation = Callable[..., Any]


@dataclass(frozen=True, slots=True)
class Signal:
    """Input or output: name (ending in its unit), unit, and the sensor's errors if it has one.

    `sigma` is the standard deviation of its noise; `bias_sd` and `gain_sd` those of its calibration, one draw an
    installation: a constant in the signal's unit, and a share of the value.
    """

    name: str
    unit: str
    sigma: float | None = None
    bias_sd: float | None = None
    gain_sd: float | None = None

    def rename(self, name: str) -> "Signal":
        """Return the signal under its name in a record or another model."""
        return replace(self, name=name)


@dataclass(frozen=True, slots=True)
class Param:
    """A constant of the component.

    `role` is the only switch between calibrating the digital system model (free `design`) and tracking the twin
    (free `health`). A health parameter is a loss: 0 as built, larger is worse. `drift` is its random-walk
    standard deviation per square root of a flight, `unit_sd` the spread of new units, sensors included, about the
    fleet's. `sd` of a design parameter is the prior spread of aircraft about nominal, where known.
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

    @property
    def is_share(self) -> bool:
        """Whether it is a share that can't reach 1, so that its wear, -ln(1 - loss), is finite."""
        return self.bounds[1] < 1.0

    def with_sd(self, *, sd: float) -> "Param":
        """Return the parameter with a prior standard deviation."""
        return replace(self, sd=sd)

    def in_ln(self, name: str, *, sd: float) -> "Param":
        """Return the natural logarithm of a positive parameter; `sd` is the logarithm's."""
        low, high = map(math.log, self.bounds)
        return Param(name, f"ln {self.unit}", float(np.log(self.nominal)), (low, high), self.role, sd=sd)


@dataclass(frozen=True, slots=True)
class State:
    """State of the component, and its initial value."""

    name: str
    unit: str
    initial: float


@dataclass(frozen=True, slots=True)
class PhysicsModel:
    """Inputs, outputs, parameters, states and the equations between them.

    Attributes
    ----------
    equations : callable
        Pure and vectorised. Argument names are exactly the declared inputs, parameters and states, where there is no
        ``**values`` for the rest; returns one array an output, in the declared order (the array itself where there is
        one output).
    rates : callable, optional
        Same argument names; returns the time derivative of each state, in the declared order. Needed with states.
    step : callable, optional
        Same argument names and `dt_s`; returns each state one step later with constant inputs. By the solver
        where absent.
    solver : str
        Integration without a `step`: `adaptive`, with error control; `rk4`; or `euler`.
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
        duplicates = sorted({n for n in names if names.count(n) > 1})
        if duplicates:
            raise ValueError(f"{self.name}: declared twice: {', '.join(duplicates)}")
        for function, more in ((self.equations, set()), (self.rates, set()), (self.step, {"dt_s"})):
            if function is not None and (off := _names_apart(function, set(names) | more)):
                raise ValueError(f"{self.name}: declared and taken names differ in {', '.join(sorted(off))}")
        if bool(self.states) != (self.rates is not None):
            raise ValueError(f"{self.name}: states and rates come together or not at all")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all arguments of the equations: inputs, parameters, states."""
        return tuple(x.name for group in (self.inputs, self.params, self.states) for x in group)

    def signal(self, name: str) -> Signal:
        """Return the declared input or output of this name."""
        return next(s for s in (*self.inputs, *self.outputs) if s.name == name)

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal value of every parameter, by name."""
        return {p.name: p.nominal for p in self.params}

    def free(self, role: Role) -> tuple[Param, ...]:
        """Return the parameters of a role: `design` to calibrate, `health` to track."""
        return tuple(p for p in self.params if p.role == role)

    def param(self, name: str) -> Param:
        """Return the declared parameter of this name."""
        return next(p for p in self.params if p.name == name)

    def bounds(self, role: Role | None = None) -> Array:
        """Return lower and upper bound of each parameter (of a role). (n, 2)"""
        params = self.params if role is None else self.free(role)
        return np.array([p.bounds for p in params]).reshape(-1, 2)

    def calibrated(self, values: Mapping[str, float]) -> "PhysicsModel":
        """Return the model with these nominal values, as after a calibration."""
        extra = sorted(set(values) - set(self.nominal))
        if extra:
            raise KeyError(f"{self.name} has no parameter {', '.join(extra)}")
        return replace(self, params=tuple(replace(p, nominal=values.get(p.name, p.nominal)) for p in self.params))

    def predict(
        self,
        params: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike],
        states: Mapping[str, ArrayLike] | None = None,
    ) -> dict[str, Array]:
        """Return the outputs by name, broadcast over parameters, inputs and states.

        Missing parameters take their nominal value; missing states their initial value.
        """
        outputs = as_tuple(self.equations(**self._values(params, inputs, states)))
        return dict(zip((s.name for s in self.outputs), outputs, strict=True))

    def advance(
        self,
        params: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike],
        states: Mapping[str, ArrayLike],
        dt_s: float,
    ) -> dict[str, Array]:
        """Return the states one step later with constant inputs."""
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
            derivatives = as_tuple(self.rates(**(values | dict(zip(names, x, strict=True)))))
            return np.stack([np.broadcast_to(rate, shape) for rate in derivatives])

        return dict(zip(names, advance_states(rates, now, dt_s, self.solver), strict=True))

    def simulate(
        self,
        params: Mapping[str, ArrayLike],
        inputs: Mapping[str, ArrayLike],
        dt_s: float,
        states: Mapping[str, ArrayLike] | None = None,
        n_samples: int | None = None,
    ) -> dict[str, Array]:
        """Simulate the outputs over time; time is the first axis of inputs (n_samples, ...) and outputs.

        Sample k is computed from the states at k; the states at k + 1 follow from the inputs at k. `n_samples`
        is required where no input has a time axis.

        Raises
        ------
        ValueError
            Neither an input nor `n_samples` determines the number of samples.
        """
        series = {name: np.asarray(value) for name, value in inputs.items()}
        lengths = [len(v) for v in series.values() if v.ndim]
        if n_samples is None and not lengths:
            raise ValueError(f"{self.name}: no input over time; say n_samples")
        n_samples = max(lengths) if n_samples is None else n_samples
        now: dict[str, Any] = {s.name: s.initial for s in self.states} | dict(states or {})
        rows: list[dict[str, Array]] = []
        for k in range(n_samples):
            at_k = {name: value[k] if value.ndim else value for name, value in series.items()}
            rows.append(self.predict(params, at_k, now))
            if k + 1 < n_samples:
                now = dict(self.advance(params, at_k, now, dt_s))
        return {s.name: np.array([row[s.name] for row in rows]) for s in self.outputs}

    def _values(
        self, params: Mapping[str, ArrayLike], inputs: Mapping[str, ArrayLike], states: Mapping[str, ArrayLike] | None
    ) -> dict[str, Array]:
        initial = {s.name: s.initial for s in self.states}
        values: dict[str, Any] = self.nominal | initial | dict(params) | dict(inputs) | dict(states or {})
        missing = [n for n in self.names if n not in values]
        if missing:
            raise KeyError(f"{self.name} needs {', '.join(missing)}")
        return {name: np.asarray(values[name]) for name in self.names}


def _names_apart(function: Equation, declared_names: set[str]) -> set[str]:
    """Return names that a function takes undeclared, or leaves out without a ``**values`` to take them."""
    parameters = inspect.signature(function).parameters.values()
    own = {p.name for p in parameters if p.kind is not inspect.Parameter.VAR_KEYWORD}
    return own ^ declared_names if len(own) == len(parameters) else own - declared_names


def declared(value: float | None) -> float:
    """Return a number that a declaration may omit and that is required here.

    Raises
    ------
    ValueError
        It is omitted.
    """
    if value is None:
        raise ValueError("the declaration leaves out a number that is needed")
    return value


def as_tuple(value: Any) -> tuple[Any, ...]:
    """Return the result of equations, one array or several, as a tuple."""
    return tuple(value) if isinstance(value, (tuple, list)) else (value,)
