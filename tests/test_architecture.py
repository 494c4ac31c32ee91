"""The house: imports point one way, and the science can be used without the pipeline."""

import ast
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import hdt_core

OURS = ("hdt_core", "pipelines", "dagster_batched")
ROOT = Path(__file__).parents[1]
MODULES = sorted(m.name for m in pkgutil.walk_packages(hdt_core.__path__, "hdt_core."))


def sources(*folders: str) -> list[Path]:
    return [file for folder in folders for file in (ROOT / folder).rglob("*.py")]


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def test_science_loads_no_pipeline():
    """In one fresh interpreter, module by module: the first that drags a pipeline in is named."""
    script = (
        "import importlib, sys\n"
        f"for name in {MODULES!r}:\n"
        "    importlib.import_module(name)\n"
        "    found = {'dagster', 'duckdb', 'pipelines'} & set(sys.modules)\n"
        "    assert not found, f'{name} loads {found}'\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_top_level_is_as_agreed():
    names = (*OURS, "sql", "data_samples", "tests", "dagster.yaml", "pyproject.toml", "requirements.lock")
    assert [name for name in names if not (ROOT / name).exists()] == []


def imported(module: str, path: Path, modules: Mapping[str, Path]) -> set[str]:
    """Modules of ours that a module imports, at whatever depth, and what only a type checker is shown."""
    names = set()
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{module} imports relatively"
            names.update({f"{node.module}.{a.name}" for a in node.names} & set(modules) or {str(node.module)})
    return names & set(modules) - {module}


def circle(modules: Mapping[str, Path]) -> list[str]:
    """Modules that import each other in a circle, the first again at the end; empty where none do."""
    try:
        TopologicalSorter({name: imported(name, path, modules) for name, path in modules.items()}).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []


def test_no_modules_import_in_circle():
    """Imports inside a function and for a type checker count too: they may wait, not hide a circle."""
    names = {p: ".".join(p.relative_to(ROOT).with_suffix("").parts) for p in sources(*OURS)}
    modules = {name.removesuffix(".__init__"): path for path, name in names.items()}
    assert len(modules) > 200
    assert circle(modules) == []


def test_circle_of_imports_is_detected(tmp_path):
    texts = {
        "a": "import b\n",
        "b": "def late():\n    from c import thing\n",
        "c": "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import a\n",
    }
    paths = {name: tmp_path / f"{name}.py" for name in texts}
    for name, path in paths.items():
        path.write_text(texts[name])
    assert set(circle(paths)) == {"a", "b", "c"}


def test_house_imports_no_private_dagster():
    private = re.compile(r"^\s*(from|import) dagster\w*\._", re.MULTILINE)
    files = sources("hdt_core", "pipelines")
    assert [p.name for p in files if private.search(p.read_text(encoding="utf-8"))] == []


def test_root_of_pipelines_is_short():
    assert len(list((ROOT / "pipelines").glob("*.py"))) <= 15


def private(path: Path) -> set[str]:
    """Modules of Dagster's that a module imports and that Dagster does not offer to others."""
    names = set[str]()
    for node in ast.walk(parsed(path)):
        names |= {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
        names |= {str(node.module)} if isinstance(node, ast.ImportFrom) else set()
    return {n for n in names if re.match(r"dagster\w*\.", n) and not n.startswith("dagster_batched.")}


def test_page_lists_private_dagster():
    page = (ROOT / "dagster_batched/README.md").read_text()
    rows = re.findall(r"^\| `(\w+)` \| .* \| (.*) \|$", page, re.MULTILINE)
    listed = {name: set(re.findall(r"`(dagster\w*\.[\w.]+)`", cells)) - {"dagster.yaml"} for name, cells in rows}
    assert listed == {p.stem: private(p) for p in (ROOT / "dagster_batched").glob("*.py") if p.stem != "__init__"}


def test_private_dagster_stays_in_one_folder():
    assert {str(p): names for p in sources("pipelines", "hdt_core") if (names := private(p))} == {}


MANY_TO_MANY = {
    "hdt_core/alerts/answers.py": "a finding meets every entry of the log about the same work",
    "hdt_core/alerts/succession.py": "a case that lost its alert meets every alert of its kind",
    "hdt_core/flight/channels.py": "a reading of one pack meets those of the other at its time, of reports and log",
    "hdt_core/prognosis/choices.py": "a wash meets every flight of its pack",
    "hdt_core/prognosis/feature_rows.py": "a flight meets every unit that its pack was known to have",
    "hdt_core/prognosis/unit_lives.py": "a life meets every message of its pack, a message every sound inspection",
    "hdt_core/record/misfiled.py": "a flight unlike its aircraft's meets every other aircraft of its operator",
    "hdt_core/record/two_aircraft.py": "a break of an aircraft meets every other aircraft of its operator",
    "hdt_core/record/two_operators.py": "a flight meets every other operator of its tail",
    "hdt_core/records/unit_index.py": "an entry of the log meets every flight of its pack",
    "pipelines/intake/kept_lines.py": "missing work meets the first and the last line of a log, of the same work",
    "pipelines/intake/merge.py": "a row meets what every other file says of its key",
}
"""Where a join makes more rows than it was given, and why; what is not wanted is filtered out at once."""


def test_joins_declare_cardinality():
    """Polars fails at once where rows do not match as declared; a doubled key once took 18 GB of memory."""
    many = set()
    for path in sources(*OURS):
        name = str(path.relative_to(ROOT))
        for where, how in joins(parsed(path)):
            assert how in ("m:1", "1:1", "m:m"), f"{name}:{where} declares no cardinality"
            many |= {name} if how == "m:m" else set()
    assert many == set(MANY_TO_MANY)


def test_undeclared_join_is_detected():
    text = "a.join(b, on='k')\na.join(b, on='k', how='semi')\n', '.join(c)\na.join(b, on='k', validate='m:1')"
    assert list(joins(ast.parse(text))) == [(1, None), (4, "m:1")]


def joins(tree: ast.AST) -> Iterator[tuple[int, str | None]]:
    """Line and declared cardinality of each join of frames that can multiply rows; one of texts has one argument."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "join":
            arguments = {k.arg: k.value.value if isinstance(k.value, ast.Constant) else None for k in node.keywords}
            if "on" in arguments and arguments.get("how") not in ("semi", "anti", "cross"):
                yield node.lineno, arguments.get("validate")


def test_worker_imports_start_no_pool():
    """A worker is forked after its imports, and a fork has none of the threads that Polars then waits for."""
    names = "[open(f'/proc/self/task/{t}/comm').read() for t in os.listdir('/proc/self/task')]"
    code = f"import os, pipelines.orchestration.worker; print(*{names}, sep='')"

    threads = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()

    assert {"polars-0", "tokio-rt-worker"}.isdisjoint(threads)
