"""Configuration frozen by a trial: code, constants, libraries, declared components; and its changes since."""

import ast
import hashlib
import importlib.metadata
import importlib.util
import platform
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import duckdb

from pipelines.storage.settings import accepted_terms, changed_limits

PACKAGES = ("hdt_core", "pipelines", "dagster_batched", "sql", "hdt_trial")
LIBRARIES = ("duckdb", "numpy", "polars", "scikit-learn", "scipy")


def frozen(con: duckdb.DuckDBPyConnection, home: Path) -> dict[str, Any]:
    """Version, digest of the sources, every constant of the science, libraries, components, accepted terms and limits.

    Parameters
    ----------
    con : DuckDBPyConnection
        A catalog.
    home : Path
        The home, for the terms of the physics and the alert limits that it sets.
    """
    parts = con.execute("select component, version, limit_loss from tables.components order by 1").fetchall()
    return {
        "version": importlib.metadata.version("hybrid-digital-twin"),
        "sources": _digest(),
        "python": platform.python_version(),
        "libraries": {name: importlib.metadata.version(name) for name in LIBRARIES},
        "components": {code: f"{version}, limit {limit}" for code, version, limit in parts},
        "terms": list(accepted_terms(home)),
        "limits": list(changed_limits(home)),
        "constants": dict(constants()),
    }


def changes(before: dict[str, Any], now: dict[str, Any], where: str = "") -> list[str]:
    """List the differences, one line each."""
    lines = []
    for name in sorted({*before, *now}):
        a = before.get(name)
        b = now.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            lines += changes(a, b, f"{where}{name} ")
        elif a != b:
            lines.append(f"{where}{name}: {_short(a)} is now {_short(b)}")
    return lines


@cache
def constants() -> tuple[tuple[str, str], ...]:
    """Every constant of `hdt_core` that is a plain value: `folder/file.py NAME` and what it is, thresholds included."""
    return tuple(_constants())


def _constants() -> Iterator[tuple[str, str]]:
    for root, file in _sources("hdt_core"):
        for node in ast.parse(file.read_text("utf-8")).body:
            target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
            if not (isinstance(target, ast.Name) and target.id.isupper() and getattr(node, "value", None)):
                continue
            try:
                value = ast.literal_eval(node.value)  # type: ignore[attr-defined]
            except ValueError:
                continue
            if _is_number(value):
                yield f"{file.relative_to(root)} {target.id}", repr(value)


def _is_number(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_is_number, value.values()))
    return all(map(_is_number, value)) if isinstance(value, tuple | list) else isinstance(value, int | float)


@cache
def _digest() -> str:
    total = hashlib.sha256()
    for package in PACKAGES:
        for root, file in _sources(package):
            total.update(f"{package}/{file.relative_to(root)}\0".encode() + file.read_bytes() + b"\0")
    return total.hexdigest()


def _sources(package: str) -> Iterator[tuple[Path, Path]]:
    spec = importlib.util.find_spec(package)
    for place in spec.submodule_search_locations or () if spec else ():
        files = (f for f in Path(place).rglob("*") if f.suffix in {".py", ".sql", ".toml", ".skops"})
        yield from ((Path(place), f) for f in sorted(files))


def _short(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
