"""Long tests: `tests/long.toml` lists them in groups with the sources they guard.

`make test` leaves them out, `--long all` runs them alone, `--long changed` those of groups whose sources or tests have
changed since the group last passed (`tests/passed.json`, which such a run writes). A test named on the command line
always runs.
"""

import hashlib
import json
import re
import tomllib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LEARNED = "what the shipped base is learned from"
"""A source in `tests/long.toml` that stands for modules, known by their imports."""
PASSED = ROOT / "tests/passed.json"
NO_TESTS = 5
"""Exit code of a run that selects no test."""


@dataclass(frozen=True)
class Group:
    """Tests (node ids or their beginnings up to `/`, `::` or `[`) and files or folders that they guard."""

    name: str
    tests: frozenset[str]
    sources: tuple[str, ...]

    def holds(self, test: str) -> bool:
        """Whether a node id is one of the group's."""
        return not _beginnings(test).isdisjoint(self.tests)

    def digest(self) -> str:
        """Hash of its sources and tests."""
        total = hashlib.sha256()
        for place in sorted({*places(self.sources), *(t.partition("::")[0] for t in self.tests)}):
            for file in _files(ROOT / place):
                total.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
        return total.hexdigest()[:16]


@lru_cache(maxsize=1)
def _beginnings(test: str) -> frozenset[str]:
    """Names of a test, its file and folders by which a group may list it."""
    file, _, name = test.partition("::")
    folders = (file[: m.start()] for m in re.finditer("/", file))
    return frozenset({test, f"{file}::{name.partition('[')[0]}", file, *folders})


def places(sources: Iterable[str]) -> Iterator[str]:
    """Files and folders that a group's sources name, below the root."""
    for source in sources:
        if source != LEARNED:
            yield source
            continue
        from pipelines.learned.recipe import source_files

        yield from (file.relative_to(ROOT).as_posix() for file in source_files())


def _files(place: Path) -> Iterator[Path]:
    if not place.exists():
        raise FileNotFoundError(f"tests/long.toml names {place.relative_to(ROOT)}, which is not there")
    every = [place] if place.is_file() else sorted(f for f in place.rglob("*") if f.is_file())
    return (f for f in every if "__pycache__" not in f.parts)


def groups() -> list[Group]:
    """As listed."""
    listed = tomllib.loads((ROOT / "tests/long.toml").read_text(encoding="utf-8"))
    return [Group(name, frozenset(g["tests"]), tuple(g["sources"])) for name, g in listed.items()]


def passed() -> dict[str, str]:
    """Digest of each group when it last passed."""
    return json.loads(PASSED.read_text(encoding="utf-8")) if PASSED.exists() else {}


class LongTests:
    """Selects tests of one run and notes which groups passed."""

    def __init__(self, which: str | None, whole: bool) -> None:
        every = groups()
        before = passed() if which == "changed" else {}
        self.every = every
        self.long = which is not None
        self.whole = whole
        self.digests = {g.name: g.digest() for g in every} if which else {}
        self.chosen = [g for g in every if which and self.digests[g.name] != before.get(g.name)]
        self.failed: set[str] = set()

    def wants(self, test: str) -> bool:
        """Whether a test is part of the run."""
        return any(g.holds(test) for g in self.chosen) if self.long else not any(g.holds(test) for g in self.every)

    def pytest_ignore_collect(self, collection_path: Path) -> bool | None:
        """Import no file all of whose tests are long: seconds of libraries that no other test needs."""
        place = collection_path.relative_to(ROOT).as_posix()
        return True if not self.long and any(g.holds(place) for g in self.every) else None

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Leave out what is not part of the run."""
        dropped = [item for item in items if not self.wants(item.nodeid)]
        items[:] = [item for item in items if self.wants(item.nodeid)]
        config.hook.pytest_deselected(items=dropped)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note the groups of tests that failed."""
        if report.failed:
            self.failed |= {g.name for g in self.chosen if g.holds(report.nodeid)}

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session, exitstatus: int) -> None:
        """Write which groups passed; that no group has changed is no fault."""
        if self.long and exitstatus == NO_TESTS and not self.chosen:
            session.exitstatus = 0
        if self.long and self.whole and exitstatus in (0, 1):
            fresh = {g.name: self.digests[g.name] for g in self.chosen if g.name not in self.failed}
            earlier = {g.name: digest for g in self.every if (digest := passed().get(g.name))}
            PASSED.write_text(json.dumps(earlier | fresh, indent=2, sort_keys=True) + "\n", encoding="utf-8")


def pytest_addoption(parser: pytest.Parser) -> None:
    """`--long all` or `--long changed`."""
    parser.addoption("--long", choices=("all", "changed"), help="run the tests of tests/long.toml, not the others")


def pytest_configure(config: pytest.Config) -> None:
    """Select in a run that names no tests; in a worker of xdist the options are those of its controller."""
    if config.getoption("file_or_dir"):
        return
    worker = hasattr(config, "workerinput")
    part = any(config.getoption(name) for name in ("keyword", "markexpr", "collectonly", "lf", "maxfail"))
    whole = not worker and not part
    config.pluginmanager.register(LongTests(config.getoption("--long"), whole), "long_tests")
