"""The page on bad input tells every reason the code can give, and no other."""

from pathlib import Path

from pipelines.intake.reasons import as_markdown

PAGE = Path(__file__).parents[3] / "docs" / "bad-input.md"


def test_page_holds_the_table_of_reasons():
    page = PAGE.read_text()
    assert as_markdown() in page
    assert page.count("| `") == as_markdown().count("| `")
