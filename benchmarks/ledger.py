"""Priors and thresholds, their sources, and the effect of halving and doubling them: `python -m benchmarks.ledger`.

    python -m benchmarks.ledger changes --fleets NAME HOME TRUTH [...] --results FILE [--only PATTERN ...] [--every N]
    python -m benchmarks.ledger effects --results FILE --write

Claim: no figure hangs on a number that somebody chose. `constants.toml` holds every constant with its source. `changes`
changes one in a copy of the sources, makes again what follows from it (`benchmarks.chain`) on fleets that another
simulator flew, and scores it against their truth; a line of the results file a run, so that it goes on where it
stopped. `effects` puts the list into docs/constants.md; a change that the results file does not hold stays as the page
has it. The shipped base of the prognosis is not learned again.
"""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from functools import cache
from inspect import signature
from itertools import product
from pathlib import Path
from typing import Any

import grimp
import polars as pl

from benchmarks import chain
from benchmarks.alerts import overall, tally
from benchmarks.changed_source import changed
from benchmarks.fleets import read_record, read_truth, thinned, true_lives
from benchmarks.harness import Texts, run
from benchmarks.twin import fouling_numbers
from hdt_core.prognosis.metrics import join_outcomes, score_prognoses

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "constants.md"
UNMOVED = "No figure moved beyond these limits for "
LEDGER = Path(__file__).with_name("constants.toml")
FACTORS = (0.5, 2.0)
WAYS = ("/2", "x2")
MOVES = {
    "alerted": 0.02, "lead": 10.0, "early": 0.7, "false": 0.7, "diagnosis": 0.03, "fouling": 0.002,
    "fouling score": 0.01, "yield": 0.02, "contamination": 0.01, "RUL score": 0.02, "coverage": 0.02, "AUC": 0.01,
}  # fmt: skip
"""What is worth telling of each figure: a tenth or so of the distance from useful to useless."""


@dataclass(frozen=True, slots=True)
class Constant:
    """One entry of the ledger: where it stands, what it rests on, and how it is halved and doubled."""

    module: str
    path: str
    source: str
    scale: str = "value"


def ledger() -> list[Constant]:
    """All entries of `constants.toml`, in its order."""
    constants = []
    for module, entries in tomllib.loads(LEDGER.read_text())["constant"].items():
        for path, entry in entries.items():
            constants.append(Constant(module, path, **(entry if isinstance(entry, dict) else {"source": entry})))
    return constants


def figures(tables: chain.Tables) -> dict[str, float]:
    """Compute the figures that measure a change, keys of `MOVES`."""
    lives = true_lives(tables["features"], tables["truth"], tables["events"])
    life = score_prognoses(join_outcomes(tables["prognoses"], tables["features"], lives))
    key = ["tail", "flight_id", "pack"]
    legs = tables["truth"].filter("arrived").join(tables["admitted"].select(*key, "admitted"), on=key)
    worn = tables["health"].filter(parameter="hx_fouling").drop_nulls("value").join(tables["truth"], on=key)
    worn = worn.with_columns(a=1.0 - pl.col("apparent_ua_ratio"), t=1.0 - pl.col("ua_ratio"), seed=pl.lit(0))
    wear = fouling_numbers(worn)
    return {name: float(v) for name, v in {
        **overall(tally(tables)),
        "fouling": wear["fouling, mean absolute error"], "fouling score": wear["interval score"],
        "yield": legs.filter("nominal")["admitted"].mean(),
        "contamination": legs.filter("admitted")["contaminant"].mean(),
        "RUL score": 1.0 - life["interval_skill"], "coverage": life["coverage"], "AUC": life["auc"],
    }.items()}  # fmt: skip


@cache
def _graph() -> grimp.ImportGraph:
    return grimp.build_graph("hdt_core", cache_dir=None)


def affected(module: str) -> list[str]:
    """Return the steps of the chain that depend on a module."""
    steps = []
    for step in chain.STEPS:
        uses = {v.__module__ for n in step.__code__.co_names if (v := getattr(chain, n, None)) and callable(v)}
        own = {m for m in uses if m.startswith("hdt_core")}
        if module in own or any(module in _graph().find_upstream_modules(m) for m in own):
            steps.append(step.__name__)
    return steps


def rerun(tables: chain.Tables, steps: list[str]) -> chain.Tables:
    """Rerun these steps, and every step that reads what they changed."""
    tables = dict(tables)
    changed_tables = set[str]()
    for step in chain.STEPS:
        reads = set(signature(step).parameters)
        if step.__name__ in steps or reads & changed_tables:
            new = step(**{name: tables[name] for name in reads})
            changed_tables |= {name for name, value in new.items() if not same(value, tables[name])}
            tables |= new
    return tables


def same(one: Any, other: Any) -> bool:
    if isinstance(one, pl.DataFrame):
        return bool(one.equals(other))
    return pickle.dumps(one) == pickle.dumps(other)


def try_change(constant: Constant, factor: float, pickled: Path, copy: Path) -> dict[str, float]:
    """Compute the figures with one constant changed, in a process on a copy of the sources."""
    file = copy.joinpath(*constant.module.split(".")).with_suffix(".py")
    source = file.read_text()
    file.write_text(changed(source, constant.path, factor, constant.scale))
    command = [sys.executable, "-m", "benchmarks.ledger", "one", "--kept", str(pickled)]
    command += ["--steps", *affected(constant.module)]
    environment = os.environ | {"PYTHONPATH": str(copy)}
    done = subprocess.run(command, check=False, cwd=copy, env=environment, capture_output=True, text=True)
    file.write_text(source)
    if done.returncode:
        return {"error": done.stderr.strip().splitlines()[-1]}  # type: ignore[dict-item]
    return dict(json.loads(done.stdout.splitlines()[-1]))


def copy_sources(folder: Path) -> Path:
    """Copy the sources below a folder."""
    for package in ("hdt_core", "pipelines", "benchmarks", "dagster_batched"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def changes(fleets: tuple[str, ...], results: Path, only: tuple[str, ...] = ("*",), every: int = 1) -> Texts:
    """Make the changes missing from the results file: of the constants that match `only` (patterns of module:constant),
    on one aircraft in `every` of each fleet.
    """
    threes = list(zip(*[iter(fleets)] * 3, strict=True))
    for name, home, folder in threes:
        pickled = results.with_suffix(f".{name}.pickle")
        if not pickled.exists():
            tables = chain.run(thinned(read_record(Path(home)) | read_truth(Path(folder)), every))
            pickled.write_bytes(pickle.dumps(tables))
            yield "", _note(results, {"fleet": name, "at": "", "factor": 1.0, "figures": figures(tables)})
    done = {(r["fleet"], r["at"], r["factor"]) for r in _read_results(results)}
    with tempfile.TemporaryDirectory() as folder:
        copy = copy_sources(Path(folder))
        for constant, (name, _, _), factor in product(ledger(), threes, FACTORS):
            at = f"{constant.module}:{constant.path}"
            if any(fnmatch(at, pattern) for pattern in only) and (name, at, factor) not in done:
                result = try_change(constant, factor, results.with_suffix(f".{name}.pickle"), copy)
                yield "", _note(results, {"fleet": name, "at": at, "factor": factor, "figures": result})


def _note(results: Path, row: dict[str, Any]) -> str:
    line = json.dumps(row)
    with results.open("a") as file:
        file.write(line + "\n")
    return line


def _read_results(results: Path) -> Iterator[dict[str, Any]]:
    if results.exists():
        yield from map(json.loads, results.read_text().splitlines())


def table(results: Path) -> str:
    """The ledger: a line for each constant that moved a figure by more than `MOVES`, and the names of the others."""
    rows = {(r["fleet"], r["at"], r["factor"]): r["figures"] for r in _read_results(results)}
    fleets = sorted({fleet for fleet, _, _ in rows})
    lines = []
    unmoved = []
    stood = standing_cells()
    for constant in ledger():
        at = f"{constant.module}:{constant.path}"
        name = f"`{at.removeprefix('hdt_core.')}`"
        standing = stood.get(name)
        cells = {
            f"{f}{w}": _format_changes(rows[f, at, k], rows[f, "", 1.0])
            if (f, at, k) in rows
            else "not run"
            if standing is None
            else standing.get(f"{f}{w}", "-")
            for f in fleets
            for k, w in zip(FACTORS, WAYS, strict=True)
        }
        effects = "; ".join(f"{way}: {cell}" for way, cell in cells.items() if cell != "-")
        if effects:
            lines.append(f"- {name}: {constant.source} -> {effects}")
        else:
            unmoved.append(name)
    return "\n".join([*lines, *([f"\n{UNMOVED}{', '.join(unmoved)}."] if unmoved else [])])


def standing_cells() -> dict[str, dict[str, str]]:
    """Read the effects listed on the page, by constant and change; none for those that moved nothing."""
    lines = PAGE.read_text().splitlines()
    moved = [line.removeprefix("- ").partition(" -> ") for line in lines if line[:3] == "- `"]
    names = re.findall("`[^`]+`", " ".join(line for line in lines if line.startswith(UNMOVED)))
    figures = r"(\w+?(?:/2|x2)): ([^;]+)"
    cells = {left.partition(": ")[0]: dict(re.findall(figures, effects)) for left, _, effects in moved}
    return {name: {} for name in names} | cells


def _format_changes(now: dict[str, Any], before: dict[str, float]) -> str:
    if "error" in now:
        return f"fails: {now['error'][:60]}"
    changes = {name: now[name] - before[name] for name, least in MOVES.items() if abs(now[name] - before[name]) > least}
    return ", ".join(f"{name} {by:+.2g}" for name, by in changes.items()) or "-"


def effects(results: Path) -> Texts:
    """Put the list into the page."""
    yield "ledger", table(results)


def one(kept: Path, steps: tuple[str, ...] = ()) -> Texts:
    """Compute the figures after these steps, for `changes`, in a process on changed sources."""
    yield "", json.dumps(figures(rerun(pickle.loads(kept.read_bytes()), list(steps))))


if __name__ == "__main__":
    run(changes, effects, one, page=PAGE)
