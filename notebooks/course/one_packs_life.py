"""Lesson 2, one pack's life: wear, work and what was foretold, with what came of it."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(app_title="One pack's life")

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
    lives = con.sql(
        "select operator, tail, pack, life, ended_by, n_flights, first_flight_id, end_flight_id from unit_lives"
        " where component = 'HX' order by (ended_by = 'message') desc nulls last, n_flights desc"
    ).pl()
    chosen = lives.row(0, named=True)
    key = [chosen["operator"], chosen["tail"], chosen["pack"]]
    mo.vstack(
        [
            mo.md(f"# One pack's life\n\nPack {key[2]} of {key[1]}. A life runs from one replacement to the next;"
                  " it ends in an *event* where the aircraft's message led to the replacement."),
            lives,
        ]
    )  # fmt: skip
    return (key,)


@app.cell
def _(con, key):
    of_pack = "where operator = ? and tail = ? and pack = ?"
    fouling = con.sql(
        f"select departed_at, value, sd from health_parameters {of_pack} and parameter = 'hx_fouling'"
        " and value is not null order by 1",
        params=key,
    ).pl()
    told = con.sql(
        f"select departed_at, rul_low, rul_flights, rul_high, seen_flights, outcome, interval_held"
        f" from prognosis_outcomes {of_pack} and component = 'HX' order by 1",
        params=key,
    ).pl()
    work = con.sql(f"select done_on, action, finding from tables.raw_maintenance {of_pack} order by 1", params=key).pl()
    return fouling, told, work


@app.function
def drawn(fouling, told) -> Figure:
    """Wear above, below it what was foretold with its interval and what came."""
    figure = Figure(figsize=(8, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    at, lost = fouling["departed_at"].to_list(), 100 * fouling["value"].to_numpy()
    sd = 100 * fouling["sd"].to_numpy()
    above.fill_between(at, lost - 1.645 * sd, lost + 1.645 * sd, alpha=0.2, lw=0)
    above.plot(at, lost)
    above.set(ylabel="% of conductance lost")
    at = told["departed_at"].to_list()
    low, high = told["rul_low"].to_list(), told["rul_high"].to_list()
    below.fill_between(at, low, high, alpha=0.2, lw=0, label="90 % interval")
    below.plot(at, told["rul_flights"].to_list(), label="foretold")
    ended = told.filter(outcome="event")
    below.plot(ended["departed_at"].to_list(), ended["seen_flights"].to_list(), "k.", ms=3, label="came")
    below.set(ylabel="flights left", ylim=(0, 310))
    below.legend(frameon=False)
    below.xaxis.set_major_formatter(ConciseDateFormatter(below.xaxis.get_major_locator()))
    return figure


@app.cell
def _(fouling, told, work):
    held = told["interval_held"].drop_nulls()
    share = f"{100 * held.mean():.0f} % of {held.len()}" if held.len() else "none"
    mo.vstack([drawn(fouling, told), mo.md(f"The interval held for {share} prognoses that can be judged."), work])


if __name__ == "__main__":
    app.run()
