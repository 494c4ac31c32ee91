"""The cookbook's sixteen queries answer as the page says."""

from cookbook import PAGE, answer, recipes

from pipelines.storage.catalog import connect


def test_queries_answer_as_published(sample_home):
    page = PAGE.read_text(encoding="utf-8")
    pairs = recipes(page)
    assert len(pairs) == page.count("```sql") == page.count("\n## ") == 16
    with connect(sample_home) as con:
        wrong = [sql for sql, expected in pairs if answer(con, sql) != expected]
    assert wrong == [], "run `python tests/support/cookbook.py HOME`"
