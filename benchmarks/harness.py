"""Shared parts of the benchmarks: arguments, times, Markdown tables, and marked sections of docs/."""

import argparse
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from inspect import Parameter, signature
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_origin

from hdt_benchmark import timing
from hdt_benchmark.timing import Claim, clock, times

Texts = Iterator[tuple[str, str]]
"""Marks of a page and what stands there."""
DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "benchmark.md"
README = DOCS.parent / "README.md"
EMPTY: Mapping[str, Path] = MappingProxyType({})


def arguments(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser described by the module's docstring `doc`."""
    return argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_write(parser: argparse.ArgumentParser) -> None:
    """Add the option `--write`."""
    parser.add_argument("--write", action="store_true", help="put what is found into its page of docs/")


def run(*mains: Callable[..., Texts], page: Path = PAGE, elsewhere: Mapping[str, Path] = EMPTY) -> None:
    """Run a benchmark from the command line: the parameters of `main` are options, its results marks and texts.

    Of several mains the first word names one. A tuple takes several values. Each text is shown as it comes and, with
    `--write` and a mark, put into the page; marks `elsewhere` stand in pages of their own.
    """
    parser = arguments(sys.modules[mains[0].__module__].__doc__)
    verbs = parser.add_subparsers(required=True) if len(mains) > 1 else None
    for main in mains:
        own = verbs.add_parser(main.__name__.replace("_", "-"), help=main.__doc__) if verbs else parser
        add_write(own)
        own.set_defaults(main=main)
        for name, parameter in signature(main).parameters.items():
            add_option(own, name, parameter)
    options = vars(parser.parse_args())
    main = options.pop("main")
    write = options.pop("write")
    written_by = f"\n\n{origin()}" if write else ""
    for mark, text in main(**options):
        show(mark, f"{text}{written_by}", elsewhere.get(mark, page), write=write)


def origin() -> str:
    """Name the command that runs and the commit it runs on, for the tables that it writes.

    Pages do not count as changed sources: a table does not depend on the one written before it.
    """
    commit = _git("rev-parse", "--short=8", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", ":/", ":!/docs", ":!/README.md")
    module = sys.modules["__main__"].__spec__
    words = " ".join(["python -m", module.name if module else "", *sys.argv[1:]])
    return f"Written by `{words}` at {commit}{'-dirty' if changed else ''}."


def _git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=DOCS, capture_output=True, text=True, check=True).stdout.strip()


def add_option(parser: argparse.ArgumentParser, name: str, parameter: Parameter) -> None:
    """Add the option of a parameter: as its default has it, or by its type and required."""
    default = parameter.default
    option = "--" + name.replace("_", "-")
    if default is Parameter.empty:
        many = get_origin(parameter.annotation) is tuple
        kind = {"type": str, "nargs": "+"} if many else {"type": parameter.annotation}
        parser.add_argument(option, required=True, **kind)
    elif isinstance(default, bool):
        parser.add_argument(option, action="store_true")
    elif isinstance(default, tuple):
        parser.add_argument(option, default=default, nargs="*", type=type(next(iter(default), "")))
    else:
        parser.add_argument(option, default=default, type=type(default))


def machine() -> str:
    """Describe the machine in one line."""
    return f"Machine: {os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}."


def best_cpu_s(contestants: dict[str, Callable[[], object]], rounds: int) -> dict[str, float]:
    """Run the contestants in turn; return the least processor time of each. [s]"""
    best = dict.fromkeys(contestants, float("inf"))
    for _ in range(rounds):
        for name, work in contestants.items():
            began = time.process_time()
            work()
            best[name] = min(best[name], time.process_time() - began)
    return best


def count_time(owner: Any, name: str, spent: list[float]) -> None:
    """Replace a function of `owner` by one that adds its wall and processor time to `spent`. [s]"""
    call = getattr(owner, name)

    def counted(*args: Any, **kwargs: Any) -> Any:
        began = time.perf_counter(), time.process_time()
        try:
            return call(*args, **kwargs)
        finally:
            spent[0] += time.perf_counter() - began[0]
            spent[1] += time.process_time() - began[1]

    setattr(owner, name, counted)


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table: head, then rows."""
    head, *rows = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([head, "| --- |" + " ---: |" * (len(lines[0]) - 1), *rows])


def race_table(claims: Iterable[Claim], packages: Sequence[str]) -> str:
    """Return a Markdown table of claims, followed by machine and versions."""
    lines = [["work", "who", "time", "per second", "ratio", "goal", "answers apart"]]
    for claim in claims:
        for place, (name, seconds) in enumerate(claim.seconds.items()):
            goal = f"{claim.goals[name]:g} x" if name in claim.goals else "-"
            ratio, apart = (times(claim.ratios[name]), f"{claim.apart[name]:.0e}") if place else ("-", "-")
            work = "" if place else claim.work
            lines.append([work, name, clock(seconds), f"{1.0 / seconds:,.0f}", ratio, goal, apart])
    return f"{markdown(lines)}\n\n{timing.machine(packages)}"


def show(mark: str, text: str, page: Path = PAGE, *, write: bool) -> None:
    """Print a text; with `write` and a mark, put it between the marks of that name in its page."""
    print(f"\n## {mark}\n\n{text}" if mark else text, flush=True)
    if write and mark:
        put(mark, text, page)


def put(mark: str, text: str, page: Path = PAGE) -> None:
    """Put a text between the page's marks of that name."""
    begin = f"<!-- {mark}: begin -->"
    end = f"<!-- {mark}: end -->"
    before, rest = page.read_text().split(begin)
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{rest.split(end)[1]}")
