"""Composition of components by named ports into one declared model."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from hdt_core.physics.compressor import COMPRESSOR
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER
from hdt_core.physics.installed_exchanger import RAM_DUCT
from hdt_core.physics.model import PhysicsModel, Signal, as_tuple

Kind = Literal["equations", "rates", "step"]


def compose(name: str, parts: Sequence[PhysicsModel], connections: Mapping[str, str]) -> PhysicsModel:
    """Join components by named ports.

    Parameters
    ----------
    parts : sequence of PhysicsModel
        In order of the air's path: an output can only feed a later part.
    connections : mapping
        Input port, as ``part.signal``, to what feeds it: the output port of an earlier part, also ``part.signal``, or
        an input of the whole by its bare name:
        ``{"heat_exchanger.hot_in_k": "compressor.cc_out_k", "heat_exchanger.cold_in_k": "tat_k"}``.

    Returns
    -------
    PhysicsModel
        Inputs: those no port feeds; inputs of the same name are one signal. Outputs, parameters, states: all of them.

    Raises
    ------
    ValueError
        A port that does not exist, a loop, or two parts that declare the same parameter, state or output.
    """
    inputs: dict[str, Signal] = {}
    for part in parts:
        inputs |= {s.name: s for s in part.inputs if f"{part.name}.{s.name}" not in connections}
    _check(parts, connections, inputs)
    states = tuple(s for part in parts for s in part.states)

    def evaluate(kind: Kind, values: dict[str, Any]) -> tuple[Any, ...]:
        signals = dict(values)  # the whole's inputs by bare name, outputs by `part.signal`
        results: list[Any] = []
        for part in parts:
            arguments = {n: signals[connections.get(f"{part.name}.{n}", n)] for n in part.names}
            outputs = as_tuple(part.equations(**arguments))
            signals |= {f"{part.name}.{s.name}": value for s, value in zip(part.outputs, outputs, strict=True)}
            results += outputs if kind == "equations" else _states_of(part, kind, arguments, values)
        return tuple(results)

    return PhysicsModel(
        name=name,
        inputs=tuple(inputs.values()),
        outputs=tuple(s for part in parts for s in part.outputs),
        params=tuple(p for part in parts for p in part.params),
        equations=lambda **values: evaluate("equations", values),
        states=states,
        rates=(lambda **values: evaluate("rates", values)) if states else None,
        step=(lambda **values: evaluate("step", values)) if states else None,
    )


def _check(parts: Sequence[PhysicsModel], connections: Mapping[str, str], inputs: Mapping[str, Signal]) -> None:
    available = set(inputs)
    unused = set(connections)
    outputs = [s.name for part in parts for s in part.outputs]
    duplicates = sorted({n for n in outputs if outputs.count(n) > 1})
    if duplicates:
        raise ValueError(f"two parts put out {', '.join(duplicates)}")
    for part in parts:
        for port in (f"{part.name}.{s.name}" for s in part.inputs):
            if port in connections and connections[port] not in available:
                raise ValueError(f"{port} is fed by {connections[port]}, which no earlier part puts out")
            unused.discard(port)
        available |= {f"{part.name}.{s.name}" for s in part.outputs}
    if unused:
        raise ValueError(f"no such input port: {', '.join(sorted(unused))}")


def _states_of(
    part: PhysicsModel, kind: Kind, arguments: Mapping[str, Any], values: Mapping[str, Any]
) -> tuple[Any, ...]:
    """Return rates of a part's states, or the states a step later."""
    if not part.states or part.rates is None:
        return ()
    if kind == "rates":
        return as_tuple(part.rates(**arguments))
    return tuple(part.advance(arguments, {}, {s.name: arguments[s.name] for s in part.states}, values["dt_s"]).values())


PACK = compose(
    "pack",
    (COMPRESSOR, RAM_DUCT, HEAT_EXCHANGER),
    {
        "heat_exchanger.hot_in_k": "compressor.cc_out_k",
        "heat_exchanger.hot_flow_kg_s": "compressor.cc_flow_kg_s",
        "heat_exchanger.ram_flow_kg_s": "ram_duct.ram_flow_kg_s",
        "heat_exchanger.cold_in_k": "tat_k",
    },
)
"""Equations (2)-(5), the ram duct and the exchanger in one declaration."""
