"""Lesson 4, what an alert rests on: then and now, its witnesses, and what else it could be."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(app_title="What an alert rests on")

with app.setup:
    import os
    from pathlib import Path

    import duckdb
    import marimo as mo
    from matplotlib.dates import ConciseDateFormatter
    from matplotlib.figure import Figure


@app.cell
def _():
    home = Path(os.environ.get("HDT_HOME", "hdt_home"))
    con = duckdb.connect(str(home / "catalog.duckdb"), read_only=True)
    _ = con.sql("set TimeZone = 'UTC'")
    return (con,)


@app.cell
def _(con):
    alerts = con.sql("from alert_states where component = 'HX' order by closed_at desc nulls first, raised_at").pl()
    alert = alerts.row(0, named=True)
    mo.md(
        f"# What an alert rests on\n\n{alert['diagnosis']} of {alert['tail']} pack {alert['pack']}, raised on"
        f" {alert['raised_on']}, severity {alert['raised_severity']} then and {alert['severity']} now."
    )
    return (alert,)


@app.function
def sentences(evidence: str) -> str:
    """Evidence as a list: what moved, then witnesses that support it, say nothing or speak against it."""
    marks = ("Supports:", "Neutral:", "Against:", "Else:", "Waiting")
    told = evidence
    for mark in marks:
        told = told.replace(f" {mark}", f"\n- **{mark}**")
    return f"- {told}"


@app.cell
def _(alert):
    mo.vstack(
        [
            mo.md("## When it was raised"),
            mo.md(sentences(alert["evidence"])),
            mo.md("## Now"),
            mo.md(sentences(alert["evidence_now"])),
            mo.md(f"## What to do\n\n{alert['recommended_action']}"),
        ]
    )


@app.cell
def _(alert, con):
    key = [alert["operator"], alert["tail"], alert["pack"]]
    witnesses = con.sql(
        "select departed_at, hx_fouling, hx_fouling_between_packs, door_median_between_packs, hx_margin_k from features"
        " where operator = ? and tail = ? and pack = ? order by 1",
        params=key,
    ).pl()
    return (witnesses,)


@app.function
def drawn(witnesses, raised_at) -> Figure:
    """The loss, the same against the other pack, and the margin; the line is the day of the alert."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    named = {"hx_fouling": "loss", "hx_fouling_between_packs": "less the other pack's", "hx_margin_k": "margin, K"}
    for place, (name, label) in zip(axes, named.items(), strict=True):
        place.plot(witnesses["departed_at"].to_list(), witnesses[name].to_list(), lw=1)
        place.axvline(raised_at, color="black", ls=":")
        place.set(ylabel=label)
    axes[-1].xaxis.set_major_formatter(ConciseDateFormatter(axes[-1].xaxis.get_major_locator()))
    return figure


@app.cell
def _(alert, con, witnesses):
    outcome = con.sql("from alert_outcomes where alert_id = ?", params=[alert["alert_id"]]).pl()
    kinds = con.sql("select diagnosis, outcome, count(*) as alerts from alert_outcomes group by all order by all").pl()
    said = mo.md("## What came of it, and of its kind so far")
    mo.vstack([drawn(witnesses, alert["raised_at"]), said, outcome, kinds])


if __name__ == "__main__":
    app.run()
