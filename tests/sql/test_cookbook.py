"""The cookbook's twenty queries answer as the page says."""

from cookbook import PAGE, answer, recipes

from pipelines.storage.catalog import connect


def test_each_query_has_the_answer_that_the_page_gives(sample_home):
    page = PAGE.read_text(encoding="utf-8")
    asked = recipes(page)
    assert len(asked) == page.count("```sql") == page.count("\n## ") == 20
    with connect(sample_home) as con:
        wrong = [sql for sql, said in asked if answer(con, sql) != said]
    assert wrong == [], "run `python tests/support/cookbook.py HOME`"
