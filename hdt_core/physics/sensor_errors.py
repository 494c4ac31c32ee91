"""Declared calibration errors of sensors as parameters of the model: a constant and a gain of each, once a pack."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from hdt_core.physics.model import Array, Equation, Param, PhysicsModel, Signal, as_tuple

WIDEST_SD = 6.0
"""Bounds of an error, in its declared standard deviations."""
BIAS, GAIN = "bias_", "gain_"


def with_sensor_errors(model: PhysicsModel) -> PhysicsModel:
    r"""Return the model with a design parameter for each `bias_sd` and `gain_sd` that it declares.

    Parameters
    ----------
    model : PhysicsModel
        Of measured inputs and outputs. Without declared errors it is returned as it is.

    Returns
    -------
    PhysicsModel
        Its parameters `bias_<signal>` (signal's unit) and `gain_<signal>` [-] are 0 at first, with the declared prior.

    Notes
    -----
    .. math:: y_\mathrm{measured} = (1 + g) \, y + b

    Examples
    --------
    >>> tat = Signal("tat_k", "K", bias_sd=0.5)
    >>> out = Signal("out_k", "K", sigma=0.3)
    >>> model = PhysicsModel("duct", (tat,), (out,), (), lambda tat_k: tat_k)
    >>> float(with_sensor_errors(model).predict({"bias_tat_k": 1.0}, {"tat_k": 300.0})["out_k"])
    299.0
    """
    errors = tuple(p for s in (*model.inputs, *model.outputs) for p in _errors(s))
    new = tuple(p for p in errors if p.name not in model.nominal)
    if not new:
        return model
    outputs = tuple(s.name for s in model.outputs)

    def equations(**values: Any) -> tuple[Array, ...]:
        results = as_tuple(model.equations(**_true_inputs(model, values)))
        return tuple(_measured(y, name, values) for name, y in zip(outputs, results, strict=True))

    return replace(
        model,
        params=(*model.params, *new),
        equations=equations,
        rates=_of_true_inputs(model, model.rates),
        step=_of_true_inputs(model, model.step),
    )


def _errors(signal: Signal) -> tuple[Param, ...]:
    """Return the parameters of one sensor's calibration errors."""
    declared = ((BIAS, signal.unit, signal.bias_sd), (GAIN, "-", signal.gain_sd))
    return tuple(
        Param(f"{kind}{signal.name}", unit, 0.0, (-WIDEST_SD * sd, WIDEST_SD * sd), "design", sd=sd)
        for kind, unit, sd in declared
        if sd is not None
    )


def _measured(value: Array, name: str, values: dict[str, Any]) -> Array:
    scaled: Array = value * (1.0 + values.get(f"{GAIN}{name}", 0.0)) + values.get(f"{BIAS}{name}", 0.0)
    return scaled


def _true_inputs(model: PhysicsModel, values: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments of the equations, the sensors' errors taken off the inputs."""
    signals = {s.name for s in model.inputs}
    return {
        name: (values[name] - values.get(f"{BIAS}{name}", 0.0)) / (1.0 + values.get(f"{GAIN}{name}", 0.0))
        if name in signals
        else values[name]
        for name in model.names
    }


def _of_true_inputs(model: PhysicsModel, function: Equation | None) -> Callable[..., Any] | None:
    if function is None:
        return None

    def with_true_inputs(**values: Any) -> Any:
        more = {name: v for name, v in values.items() if name == "dt_s"}
        return function(**_true_inputs(model, values), **more)

    return with_true_inputs
