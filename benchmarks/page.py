"""Tables in the pages of docs/: each between marks of its own."""

from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "benchmark.md"


def write(mark: str, text: str, page: Path = PAGE) -> None:
    """Put a text between the page's marks of that name."""
    begin, end = f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, rest = page.read_text().split(begin)
    page.write_text(f"{before}{begin}\n\n{text}\n\n{end}{rest.split(end)[1]}")
