"""Which small edits of a room do its tests notice? `make mutate ROOM=margin [SAMPLE=60] [SEED=1]`.

Cosmic Ray makes the mutants. Each is tried in a copy of the tree, by a process forked from one that has loaded the
libraries and nothing of the project: the test files that import the edited module, then the rest of the room, quick
files first, up to the first failure, without the tests of `tests/long.toml`. `tests/mutants.toml` lists the mutants
that change nothing.
"""

import difflib
import gc
import importlib
import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import hypothesis
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
SEARCH = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
NO_SCIENCE = ("annassign", "decorator", "fstring", "tfpdef", "import_from", "raise_stmt")


class ScaledNumber(NumberReplacer):
    """Changes a number by 15 %, an integer by one."""

    def mutate(self, node: Number, index: int) -> Number:
        """Raise the number, or lower it."""
        value = eval(node.value)
        sign = 1 - 2 * index
        changed = value + sign if isinstance(value, int) or not value else value * (1 + 0.15 * sign)
        return Number(f" {changed!r}", node.start_pos)


def is_science(node: NodeOrLeaf) -> bool:
    """Tell code from annotations, decorators, messages and the check of `zip`."""
    parent = node.parent
    if parent is None:
        return True
    syntax = parent.type == "parameters" and node.type == "operator"
    annotation = parent.type == "funcdef" and node is parent.annotation
    check = node.type == "argument" and node.get_first_leaf().value == "strict"
    return node.type not in NO_SCIENCE and not (syntax or annotation or check) and is_science(parent)


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


class Clock:
    """Adds up the seconds of each test file."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Add one step of a test."""
        self.seconds[report.nodeid.partition("::")[0]] += report.duration


def run_tests(tests: list[str], log: Path, record: Path | None) -> None:
    """Run the tests in this process and end it; record the libraries that they loaded and the seconds of each file."""
    os.setsid()
    sys.path.insert(0, os.getcwd())
    with log.open("w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    clock = Clock()
    hypothesis.settings.register_profile("mutants", deadline=None, derandomize=True, phases=SEARCH, database=None)
    long = tomllib.loads(Path("tests/long.toml").read_text())
    deselected = [f"--deselect={test}" for group in long.values() for test in group["tests"]]
    options = ["-x", "-q", "--assert=plain", "-p", "no:xdist", "-p", "no:cacheprovider", "--hypothesis-profile=mutants"]
    code = pytest.main([*options, *deselected, *tests], plugins=[clock])
    if record:
        places = {name: getattr(module, "__file__", None) or "" for name, module in sys.modules.items()}
        libraries = [name for name, place in places.items() if "site-packages" in place]
        record.write_text(json.dumps({"libraries": libraries, "seconds": clock.seconds}))
    os._exit(code)


def passes(tests: list[str], log: Path, limit_s: float, record: Path | None = None) -> bool:
    """Run the tests in a forked process, for so long at most."""
    process = multiprocessing.get_context("fork").Process(target=run_tests, args=(tests, log, record))
    process.start()
    process.join(limit_s)
    if process.is_alive():
        print(f"  stopped after {limit_s:.0f} s", flush=True)
        os.killpg(process.pid, signal.SIGKILL)
        process.join()
    return process.exitcode == 0


def copy_tree(folder: Path) -> None:
    """Copy what a test run needs; link what nobody changes."""
    for name in COPIED:
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in LINKED:
        (folder / name).symlink_to(ROOT / name)


def load_libraries(tests: list[str]) -> dict[str, float]:
    """Run the tests once as they are, load the libraries that they use, and return the seconds of each file."""
    record = Path("unchanged.json")
    if not passes(tests, Path("unchanged.log"), 900, record):
        sys.exit(f"The tests fail on the unchanged tree:\n{Path('unchanged.log').read_text()[-2000:]}")
    recorded = json.loads(record.read_text())
    for name in recorded["libraries"]:
        importlib.import_module(name)
    gc.freeze()  # pytest collects garbage many times, a forked process each object of the libraries anew
    return recorded["seconds"]


def batches(module: str, seconds: dict[str, float]) -> list[list[str]]:
    """Split a room's test files: those that import the module, then the others; quick ones first."""
    quick = sorted(seconds, key=seconds.__getitem__)
    package, _, name = module.removesuffix(".py").replace("/", ".").rpartition(".")
    near = re.compile(rf"{package}\.{name}\b|from {package} import .*\b{name}\b")
    own = [file for file in quick if near.search(Path(file).read_text())]
    return [files for files in (own, [file for file in quick if file not in own]) if files]


def survives(mutant: tuple[str, str, str], seconds: dict[str, float]) -> bool:
    """Try one mutant (module, source, changed source)."""
    module, source, changed = mutant
    Path(module).write_text(changed)
    log = Path("mutant.log")
    alive = all(passes(files, log, 20 + 6 * sum(seconds[f] for f in files)) for files in batches(module, seconds))
    Path(module).write_text(source)
    return alive


def main(room: str, sample: int = 60, seed: int = 1, module: str = "*") -> None:
    """Mutate a sample of a room's places; print the survivors and the score."""
    register = tomllib.loads((ROOT / "tests/mutants.toml").read_text())
    tests = sorted(map(str, Path("tests/hdt_core", room).glob("test_*.py")))
    sources = {str(p.relative_to(ROOT)): p.read_text() for p in (ROOT / "hdt_core" / room).glob(f"{module}.py")}
    everything = [(name, source, *place) for name, source in sorted(sources.items()) for place in places(source)]
    sampled = random.Random(seed).sample(everything, min(sample, len(everything)))
    mutants = [(name, source, mutate_code(source, *place)) for name, source, *place in sampled]
    equivalent = {(e["module"], e["before"], after) for e in register["equivalent"] for after in e["after"]}
    tried = [(name, *texts) for name, *texts in mutants if (name, *edit(*texts)) not in equivalent]
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
        copy_tree(Path(folder))
        os.chdir(folder)
        sys.dont_write_bytecode = False
        seconds = load_libraries(tests)
        start = time.monotonic()
        caught = 0
        sys.dont_write_bytecode = True  # that of the unchanged tree stays, and of no mutant is any kept
        for number, (name, *texts) in enumerate(tried, 1):
            if survives((name, *texts), seconds):
                print("survives {}\n  before = {!r}\n  after = {!r}".format(name, *edit(*texts)), flush=True)
            else:
                caught += 1
            print(f"  {caught} of {number} caught", flush=True)
        each_s = (time.monotonic() - start) / len(tried)
    print(
        f"{room}, seed {seed}: {caught} of {len(tried)} caught, {100 * caught / len(tried):.0f} %; "
        f"{len(mutants) - len(tried)} equivalent; {len(everything)} places; {each_s:.1f} s a mutant"
    )
    sys.stdout.flush()
    os._exit(0)  # the libraries' own clean-up prints pages


if __name__ == "__main__":
    typer.run(main)
