"""The page on bad input tells every reason the code can give, and no other."""

from pathlib import Path

from pipelines.intake.faults import REASONS

PAGE = Path(__file__).parents[3] / "docs" / "bad-input.md"


def test_page_holds_the_table_of_reasons():
    rows = [f"| `{code}` | {r.scope} | {r.sentence} | {r.remedy} |" for code, r in REASONS.items()]
    assert [line for line in PAGE.read_text().splitlines() if line.startswith("| `")] == rows
