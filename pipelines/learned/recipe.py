"""Digest the sources the shipped base was learned from, and check that the present ones learn the same."""

import ast
import hashlib
import importlib
from importlib.metadata import version
from pathlib import Path

import grimp
import numpy as np

from hdt_core.prognosis import base
from hdt_core.prognosis.hazard import event_by, hazards
from pipelines.learned import shipped_base

LIBRARIES = ("numpy", "scipy", "scikit-learn")
FLEETS, SEED = 3, 991
MEAN, FAR = 0.002, 0.03
"""Differences of a probability, on average and at the 99th percentile, that another machine may make."""


def sources() -> str:
    """Digest the code that learns a base, without comments and docstrings, and the libraries it uses."""
    lines = [code_of(path.read_text()) for path in source_files()] + [f"{name} {version(name)}" for name in LIBRARIES]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def source_files() -> list[Path]:
    """List the modules that learn a base: its own and all that it imports, in order of their names."""
    graph = grimp.build_graph("hdt_core", cache_dir=None)
    modules = sorted({base.__name__} | graph.find_upstream_modules(base.__name__))
    return [Path(str(importlib.import_module(name).__file__)) for name in modules]


def code_of(text: str) -> str:
    """Return a module's syntax tree without comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.__dict__["body"] = [s for s in body if not _is_text(s)]
    return ast.dump(tree)


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def differences() -> tuple[float, float]:
    """Learn a third of the base again; return its differences in probability, mean and 99th percentile."""
    rows = base.simulated_rows(SEED, FLEETS)
    members = shipped_base().hazard[0], base.fit_member(0)
    shipped_p, new_p = (event_by(hazards([m], rows.features)) for m in members)
    difference = np.abs(shipped_p - new_p)
    return float(difference.mean()), float(np.quantile(difference, 0.99))


def learns_the_same() -> bool:
    """Compare predictions, since cuts of trees may differ between machines."""
    mean, far = differences()
    return mean < MEAN and far < FAR
