"""Lesson 5, a query: from the catalog's own words to a question of yours, and a table to learn from."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(app_title="A query")

with app.setup:
    import os
    from pathlib import Path

    import duckdb
    import marimo as mo


@app.cell
def _():
    home = Path(os.environ.get("HDT_HOME", "hdt_home"))
    con = duckdb.connect(str(home / "catalog.duckdb"), read_only=True)
    _ = con.sql("set TimeZone = 'UTC'")
    return (con,)


@app.cell
def _(con):
    views = con.sql(
        "select view_name, comment as question from duckdb_views()"
        " where schema_name = 'main' and not internal order by 1"
    ).pl()
    columns = con.sql(
        "select column_name, comment as meaning from duckdb_columns() where table_name = 'health_parameters'"
    ).pl()
    mo.vstack(
        [
            mo.md("# A query\n\nThe catalog says what it holds: every view is a question, every column is explained."),
            views,
            columns,
        ]
    )


@app.cell
def _():
    asked = mo.ui.code_editor(
        "select tail, pack, round(max(value), 2) as worst_loss\n"
        "from health_parameters where parameter = 'hx_fouling'\n"
        "group by tail, pack order by worst_loss desc",
        language="sql",
    )
    mo.vstack([mo.md("## Ask your own\n\nChange the query: the answer follows."), asked])
    return (asked,)


@app.cell
def _(asked, con):
    answer = con.sql(asked.value).pl()
    mo.vstack([answer])


@app.cell
def _(con):
    learn = con.sql(
        "select split_tail, hx_fouling, hx_fouling_slope_30_per_flight, hx_margin_k, label_hx_flights from training_set"
        " where as_stated and label_hx_flights is not null and not label_hx_censored"
    ).pl()
    (fit,) = con.sql(
        "select corr(hx_fouling, label_hx_flights) as loss, corr(hx_margin_k, label_hx_flights) as margin from learn"
    ).fetchall()
    mo.md(
        f"## A table to learn from\n\n`training_set` has {learn.height} rows whose life was seen to its end."
        f" Flights left go with the loss at a correlation of {fit[0]:.2f}, with the margin at {fit[1]:.2f}."
        " Columns that begin with `label_` are what came later: never features."
    )


if __name__ == "__main__":
    app.run()
