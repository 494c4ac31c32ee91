"""Which small edits of a room do its tests notice? `make mutate ROOM=margin [SAMPLE=60] [SEED=1]`.

Cosmic Ray makes the mutants. Each is tried in a copy of the tree, by a process forked from one that has loaded the
libraries and nothing of the project. `tests/mutants.toml` lists each room's tests and the mutants that change nothing.
"""

import difflib
import importlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.number_replacer import NumberReplacer
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator
from parso.python.tree import Number
from parso.tree import NodeOrLeaf

ROOT = Path(__file__).parents[1]
COPIED = ("hdt_core", "pipelines", "dagster_batched", "sql", "benchmarks", "tests")
LINKED = ("pyproject.toml", "data_samples", "docs")
BINARY = "Add_Sub Sub_Add Mul_Div Div_Mul Pow_Mul BitAnd_BitOr BitOr_BitAnd"
COMPARISON = "Gt_GtE GtE_Gt Lt_LtE LtE_Lt Gt_Lt Lt_Gt GtE_Lt LtE_Gt Eq_NotEq NotEq_Eq Is_IsNot IsNot_Is"
KEYWORDS = "AddNot ReplaceTrueWithFalse ReplaceFalseWithTrue ReplaceAndWithOr ReplaceOrWithAnd"
OPERATORS = (
    *(f"core/ReplaceBinaryOperator_{swap}" for swap in BINARY.split()),
    *(f"core/ReplaceComparisonOperator_{swap}" for swap in COMPARISON.split()),
    *(f"core/ReplaceUnaryOperator_Delete_{sign}" for sign in ("USub", "Not", "Invert")),
    *(f"core/{name}" for name in KEYWORDS.split()),
)
NO_SCIENCE = ("annassign", "decorator", "fstring", "tfpdef", "import_from", "raise_stmt")


class ScaledNumber(NumberReplacer):
    """Changes a number by 15 %, an integer by one."""

    def mutate(self, node: Number, index: int) -> Number:
        """Raise the number, or lower it."""
        value, sign = eval(node.value), 1 - 2 * index
        changed = value + sign if isinstance(value, int) or not value else value * (1 + 0.15 * sign)
        return Number(f" {changed!r}", node.start_pos)


def is_science(node: NodeOrLeaf) -> bool:
    """Tell code from annotations, decorators and messages."""
    parent = node.parent
    if parent is None:
        return True
    syntax = parent.type == "parameters" and node.type == "operator"
    annotation = parent.type == "funcdef" and node is parent.annotation
    return node.type not in NO_SCIENCE and not syntax and not annotation and is_science(parent)


def places(source: str) -> Iterator[tuple[Operator, int]]:
    """Yield each change that can be made to a module: an operator, and at which of its places."""
    tree = list(ast_nodes(get_ast(source)))
    for operator in (ScaledNumber(), *(get_operator(name)() for name in OPERATORS)):
        nodes = (node for node in tree for _ in operator.mutation_positions(node))
        yield from ((operator, at) for at, node in enumerate(nodes) if is_science(node))


def edit(before: str, after: str) -> tuple[str, str]:
    """Lines taken out and lines put in."""
    lines = list(difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm=""))[2:]
    return tuple(" ".join(line[1:].strip() for line in lines if line[0] == sign) for sign in "-+")


def run_tests(tests: list[str], log: Path, libraries: Path | None) -> None:
    """Run the tests in this process and end it; list the libraries that they loaded."""
    os.setsid()
    sys.path.insert(0, os.getcwd())
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    code = pytest.main(["-x", "-q", "--ff", "--assert=plain", "-p", "no:xdist", *tests])
    if libraries:
        places = {name: getattr(module, "__file__", None) or "" for name, module in sys.modules.items()}
        libraries.write_text(json.dumps([name for name, place in places.items() if "site-packages" in place]))
    os._exit(code)


def passes(tests: list[str], log: Path, limit_s: float, libraries: Path | None = None) -> bool:
    """Run the tests in a forked process, for so long at most."""
    process = multiprocessing.get_context("fork").Process(target=run_tests, args=(tests, log, libraries))
    process.start()
    process.join(limit_s)
    if process.is_alive():
        os.killpg(process.pid, signal.SIGKILL)
        process.join()
    return process.exitcode == 0


def copy_tree(folder: Path) -> None:
    """Copy what a test run needs; link what nobody changes."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in LINKED:
        (folder / name).symlink_to(ROOT / name)


def load_libraries(tests: list[str]) -> float:
    """Run the tests once as they are, load the libraries that they use, and return the seconds of a run."""
    libraries = Path("libraries.json")
    for listing in (libraries, None):
        start = time.monotonic()
        if not passes(tests, Path("unchanged.log"), 600, listing):
            sys.exit(f"The tests fail on the unchanged tree:\n{Path('unchanged.log').read_text()[-2000:]}")
        for name in json.loads(libraries.read_text()):
            importlib.import_module(name)
    return time.monotonic() - start


def survivors(drawn: list[tuple[str, str, str]], tests: list[str], limit_s: float) -> Iterator[tuple[str, str, str]]:
    """Yield the mutants (module, source, changed source) that the tests pass."""
    for mutant in drawn:
        module, source, changed = mutant
        Path(module).write_text(changed)
        if passes(tests, Path("mutant.log"), limit_s):
            yield mutant
        Path(module).write_text(source)


def main(room: str, sample: int = 60, seed: int = 1, module: str = "*") -> None:
    """Mutate a sample of a room's places; print the survivors and the score."""
    register = tomllib.loads((ROOT / "tests/mutants.toml").read_text())
    tests = register["tests"].get(room, [f"tests/hdt_core/{room}"])
    sources = {str(p.relative_to(ROOT)): p.read_text() for p in (ROOT / "hdt_core" / room).glob(f"{module}.py")}
    everything = [(name, source, *place) for name, source in sorted(sources.items()) for place in places(source)]
    sampled = random.Random(seed).sample(everything, min(sample, len(everything)))
    drawn = sorted((name, source, mutate_code(source, *place)) for name, source, *place in sampled)
    equivalent = {(e["module"], e["before"], e["after"]) for e in register["equivalent"]}
    tried = [(name, *texts) for name, *texts in drawn if (name, *edit(*texts)) not in equivalent]
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy_tree(Path(folder))
        os.chdir(folder)
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
        unchanged_s, start, alive = load_libraries(tests), time.monotonic(), []
        for name, *texts in survivors(tried, tests, 10 + 4 * unchanged_s):
            alive.append(name)
            print("survives {}\n  before = {!r}\n  after = {!r}".format(name, *edit(*texts)), flush=True)
        each_s = (time.monotonic() - start) / len(tried)
    print(
        f"{room}: {len(tried) - len(alive)} of {len(tried)} killed, {100 * (1 - len(alive) / len(tried)):.0f} %; "
        f"{len(drawn) - len(tried)} equivalent; {len(everything)} places; {each_s:.1f} s a mutant"
    )


if __name__ == "__main__":
    typer.run(main)
