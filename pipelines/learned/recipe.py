"""What the shipped base was learned from, and whether the present sources still learn the same."""

import ast
import hashlib
import importlib
from importlib.metadata import version
from pathlib import Path

import grimp
import numpy as np

from hdt_core.prognosis import model
from hdt_core.prognosis.feature_rows import simulated_rows
from hdt_core.prognosis.hazard import event_by, hazards
from pipelines.learned import shipped_base

LIBRARIES = ("numpy", "scipy", "scikit-learn")
FLEETS, SEED = 3, 991
MEAN, FAR = 0.002, 0.03
"""Differences of a probability, on average and at the 99th percentile, that another machine may make."""


def sources() -> str:
    """Digest of the code that learns a base, its comments and docstrings left out, and of the libraries it uses."""
    graph = grimp.build_graph("hdt_core", cache_dir=None)
    used = sorted({model.__name__} | graph.find_upstream_modules(model.__name__))
    told = [f"{name} {code_of(_text(name))}" for name in used] + [f"{name} {version(name)}" for name in LIBRARIES]
    return hashlib.sha256("\n".join(told).encode()).hexdigest()[:16]


def _text(module: str) -> str:
    return Path(str(importlib.import_module(module).__file__)).read_text()


def code_of(text: str) -> str:
    """A module without its comments and docstrings."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, "body", None)
        if isinstance(body, list):
            node.__dict__["body"] = [s for s in body if not _is_text(s)]
    return ast.dump(tree)


def _is_text(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def apart() -> tuple[float, float]:
    """A third of the base learned again: how far what it says differs, on average and at the 99th percentile."""
    rows = simulated_rows(SEED, FLEETS)
    members = shipped_base().hazard[0], model.fit_member(0)
    shipped, again = (event_by(hazards([m], rows.features)) for m in members)
    differs = np.abs(shipped - again)
    return float(differs.mean()), float(np.quantile(differs, 0.99))


def learns_the_same() -> bool:
    """Trees may turn at another cut on another machine; what they say may not."""
    mean, far = apart()
    return mean < MEAN and far < FAR
