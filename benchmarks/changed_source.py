"""A module's source with one constant made larger or smaller, wherever it stands in an assignment."""

import ast
from collections.abc import Iterator


def changed(source: str, path: str, factor: float, scale: str = "value") -> str:
    """Scale the numbers at `path` in the text of a module.

    Parameters
    ----------
    source : str
        The module.
    path : str
        `NAME`, a class's field `Class.field`, and from there on keys, names of arguments and places in a tuple or a
        call, `*` for all: `PRIOR.*.1`.
    factor : float
        What each number is multiplied by; whole numbers stay whole and positive.
    scale : str
        `value`; `log`: the number is the logarithm of what is scaled; `complement`: one less it is.

    Raises
    ------
    KeyError
        Nothing stands there.
    """
    name, *steps = path.split(".")
    tree = ast.parse(source)
    nodes = list(_numbers(_value(tree.body, name, steps), steps))
    if not nodes:
        raise KeyError(path)
    lines = source.splitlines(keepends=True)
    for node in sorted(nodes, key=lambda n: (n.lineno, n.col_offset), reverse=True):
        assert node.end_lineno == node.lineno
        row = lines[node.lineno - 1].encode()
        old = row[node.col_offset : node.end_col_offset].decode()
        new = _scaled(node, old, factor, scale)
        lines[node.lineno - 1] = (row[: node.col_offset] + new.encode() + row[node.end_col_offset :]).decode()
    return "".join(lines)


def _scaled(node: ast.expr, old: str, factor: float, scale: str) -> str:
    if isinstance(node, ast.Constant) and type(node.value) is int and scale == "value":
        return str(max(1, round(node.value * factor)))
    if scale == "log":
        return f"(({old}) + __import__('math').log({factor}))"
    if scale == "complement":
        return f"(1.0 - (1.0 - ({old})) * {factor})"
    return f"(({old}) * {factor})"


def _value(body: list[ast.stmt], name: str, steps: list[str]) -> ast.expr:
    """Return the expression assigned to a name; consumes a class's field from `steps`."""
    for statement in body:
        if isinstance(statement, ast.ClassDef) and statement.name == name:
            return _value(statement.body, steps.pop(0), steps)
        for assigned, value in _assigned(statement):
            if assigned == name:
                return value
    raise KeyError(name)


def _is(node: ast.expr, name: str) -> bool:
    return isinstance(node, ast.Name) and node.id == name


def _numbers(node: ast.expr, steps: list[str]) -> Iterator[ast.expr]:
    """Expressions that stand for numbers below a node."""
    if steps:
        for name, part in _parts(node):
            if steps[0] in ("*", name):
                yield from _numbers(part, steps[1:])
    elif isinstance(node, ast.Constant):
        if isinstance(node.value, int | float) and not isinstance(node.value, bool):
            yield node
    elif isinstance(node, ast.UnaryOp | ast.BinOp) or (isinstance(node, ast.Call) and _is(node.func, "float")):
        yield node
    else:
        for _, part in _parts(node):
            yield from _numbers(part, [])


def _parts(node: ast.expr) -> list[tuple[str, ast.expr]]:
    if isinstance(node, ast.Dict):
        return [(str(getattr(k, "value", "")), v) for k, v in zip(node.keys, node.values, strict=True)]
    if isinstance(node, ast.Tuple | ast.List):
        return [(str(k), v) for k, v in enumerate(node.elts)]
    if isinstance(node, ast.Call):
        return [(str(k), v) for k, v in enumerate(node.args)] + [(k.arg or "", k.value) for k in node.keywords]
    return []


def numbers(source: str) -> dict[str, ast.expr]:
    """Names that a module assigns numbers to, at its top and in its classes (`Class.field`)."""
    assignments: dict[str, ast.expr] = {}
    for statement in ast.parse(source).body:
        if isinstance(statement, ast.ClassDef):
            fields = ((f"{statement.name}.{name}", value) for s in statement.body for name, value in _assigned(s))
            assignments |= {name: value for name, value in fields if _has_number(value)}
        assignments |= {name: value for name, value in _assigned(statement) if _has_number(value)}
    return assignments


def _assigned(statement: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    if isinstance(statement, ast.AnnAssign) and statement.value and isinstance(statement.target, ast.Name):
        yield statement.target.id, statement.value
    if isinstance(statement, ast.Assign):
        target = statement.targets[0]
        value = statement.value
        pairs = [(target, value)]
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            pairs = list(zip(target.elts, value.elts, strict=True))
        yield from ((t.id, v) for t, v in pairs if isinstance(t, ast.Name))


def _has_number(node: ast.expr) -> bool:
    values = (n.value for n in ast.walk(node) if isinstance(n, ast.Constant))
    return any(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
