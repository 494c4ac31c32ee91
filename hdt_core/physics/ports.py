"""Components joined by named ports into one model with the same kind of declaration."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from hdt_core.physics.model import PhysicsModel, Signal, as_tuple, taking

Kind = Literal["equations", "rates", "step"]


def compose(name: str, parts: Sequence[PhysicsModel], connections: Mapping[str, str]) -> PhysicsModel:
    """Join components by named ports.

    Parameters
    ----------
    parts : sequence of PhysicsModel
        In the order the air meets them: an output can only feed a part that comes later.
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
    order = (*inputs, *(p.name for part in parts for p in part.params), *(s.name for s in states))

    def run(kind: Kind, values: dict[str, Any]) -> tuple[Any, ...]:
        known = dict(values)  # the whole's own inputs by bare name, outputs as they are made by `part.signal`
        found: list[Any] = []
        for part in parts:
            arguments = {n: known[connections.get(f"{part.name}.{n}", n)] for n in part.names}
            made = as_tuple(part.equations(**arguments))
            known |= {f"{part.name}.{s.name}": value for s, value in zip(part.outputs, made, strict=True)}
            found += made if kind == "equations" else _moved(part, kind, arguments, values)
        return tuple(found)

    return PhysicsModel(
        name=name,
        inputs=tuple(inputs.values()),
        outputs=tuple(s for part in parts for s in part.outputs),
        params=tuple(p for part in parts for p in part.params),
        equations=taking(order, lambda **values: run("equations", values)),
        states=states,
        rates=taking(order, lambda **values: run("rates", values)) if states else None,
        step=taking((*order, "dt_s"), lambda **values: run("step", values)) if states else None,
    )


def _check(parts: Sequence[PhysicsModel], connections: Mapping[str, str], inputs: Mapping[str, Signal]) -> None:
    made = set(inputs)
    unknown = set(connections)
    outputs = [s.name for part in parts for s in part.outputs]
    doubled = sorted({n for n in outputs if outputs.count(n) > 1})
    if doubled:
        raise ValueError(f"two parts put out {', '.join(doubled)}")
    for part in parts:
        for port in (f"{part.name}.{s.name}" for s in part.inputs):
            if port in connections and connections[port] not in made:
                raise ValueError(f"{port} is fed by {connections[port]}, which no earlier part puts out")
            unknown.discard(port)
        made |= {f"{part.name}.{s.name}" for s in part.outputs}
    if unknown:
        raise ValueError(f"no such input port: {', '.join(sorted(unknown))}")


def _moved(part: PhysicsModel, kind: Kind, arguments: Mapping[str, Any], values: Mapping[str, Any]) -> tuple[Any, ...]:
    """Rates of a part's states, or the states a step later."""
    if not part.states or part.rates is None:
        return ()
    if kind == "rates":
        return as_tuple(part.rates(**arguments))
    return tuple(part.advance(arguments, {}, {s.name: arguments[s.name] for s in part.states}, values["dt_s"]).values())
