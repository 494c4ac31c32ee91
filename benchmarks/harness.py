"""Shared parts of the benchmarks: arguments, Markdown tables, and marked sections of docs/."""

import argparse
import os
import platform
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "benchmark.md"


def arguments(doc: str | None) -> argparse.ArgumentParser:
    """Return a parser described by the module's docstring `doc`, with the option `--write`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put what is found into its page of docs/")
    return parser


def machine() -> str:
    """Describe the machine in one line."""
    return f"Machine: {os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}."


def markdown(lines: list[list[str]]) -> str:
    """Return a Markdown table: head, then rows."""
    head, *rows = ["| " + " | ".join(line) + " |" for line in lines]
    return "\n".join([head, "| --- |" + " ---: |" * (len(lines[0]) - 1), *rows])


def show(mark: str, text: str, page: Path = PAGE, *, write: bool) -> None:
    """Print a text; with `write`, put it between the marks of that name in its page."""
    print(f"\n## {mark}\n\n{text}", flush=True)
    if write:
        put(mark, text, page)


def put(mark: str, text: str, page: Path = PAGE) -> None:
    """Put a text between the page's marks of that name."""
    begin, end = f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, rest = page.read_text().split(begin)
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{rest.split(end)[1]}")
