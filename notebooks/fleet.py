"""The catalog as a reactive page: `HDT_HOME=hdt_home marimo run notebooks/fleet.py`, or `marimo edit` to change it."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(width="medium", app_title="Fleet")

with app.setup:
    import os
    from pathlib import Path

    import duckdb
    import marimo as mo
    import polars as pl
    import polars.selectors as cs
    from matplotlib.figure import Figure

    from pipelines.report.plots import BLUE, GREEN, GREY, INK, ORANGE, VERMILLION

    Z_90 = 1.645


@app.function
def shown(frame: pl.DataFrame, rows: int = 8) -> mo.ui.table:
    """A table to read: three figures, no boxes to tick."""
    return mo.ui.table(frame.with_columns(cs.float().round_sig_figs(3)), selection=None, page_size=rows)


@app.cell
def _():
    home = Path(os.environ.get("HDT_HOME", "hdt_home"))
    con = duckdb.connect(str(home / "catalog.duckdb"), read_only=True)
    _ = con.sql("set TimeZone = 'UTC'")
    return con, home


@app.cell
def _(con, home):
    ranking = con.sql("from fleet_ranking order by place").pl()
    mo.vstack(
        [
            mo.md(
                f"# The fleet\n\n{ranking.height} packs in `{home}`. Every number below is one select over the catalog."
            ),
            shown(ranking.select("place", "tail", "pack", "urgency", "hx_fouling", "rul_flights", "p_event_50")),
        ]
    )
    return (ranking,)


@app.cell
def _(ranking):
    packs = {f"{r['tail']} pack {r['pack']}": (r["operator"], r["tail"], r["pack"]) for r in ranking.to_dicts()}
    pick = mo.ui.dropdown(packs, value=next(iter(packs), None), label="Pack")
    mo.vstack([mo.md("## One pack\n\nChoose a pack: everything down to the next heading follows."), pick])
    return (pick,)


@app.cell
def _(con, pick):
    of_pack = "where operator = ? and tail = ? and pack = ?"
    key = list(pick.value or ("", "", 0))
    health = con.sql(
        f"select departed_at, parameter, value, sd from health_parameters {of_pack} and value is not null order by 1",
        params=key,
    ).pl()
    alerts = con.sql(
        f"select raised_at, closed_at, diagnosis, severity, evidence from alerts {of_pack} order by 1 desc", params=key
    ).pl()
    work = con.sql(
        f"select done_on, component, parameter, before_work, after_work, moved_by from before_and_after {of_pack}"
        " order by 1 desc",
        params=key,
    ).pl()
    return alerts, health, work


@app.function
def track(health: pl.DataFrame, alerts: pl.DataFrame, work: pl.DataFrame) -> Figure:
    """Losses over time with their 90 % band, alerts and work."""
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axes = figure.subplots()
    for name, colour, style, label in (
        ("hx_fouling", BLUE, "-", "heat exchanger, conductance"),
        ("cc_efficiency_loss", ORANGE, "--", "compressor, efficiency"),
    ):
        rows = health.filter(parameter=name)
        at, lost, sd = rows["departed_at"].to_list(), 100 * rows["value"].to_numpy(), 100 * rows["sd"].to_numpy()
        axes.fill_between(at, lost - Z_90 * sd, lost + Z_90 * sd, color=colour, alpha=0.15, lw=0)
        axes.plot(at, lost, style, color=colour, label=label)
    for day in work["done_on"].unique():
        axes.axvline(day, color=GREEN, lw=1)
    for at in alerts["raised_at"]:
        axes.axvline(at, color=INK, lw=1, ls=":")
    axes.set(ylabel="% lost", title="Health (work solid green, alerts dotted black)")
    axes.legend(loc="upper left", frameon=False)
    return figure


@app.cell
def _(alerts, health, work):
    mo.vstack(
        [
            track(health, alerts, work),
            mo.accordion(
                {
                    f"Alerts: {alerts.height}": shown(alerts),
                    f"What work changed: {work.height} rows": shown(work),
                }
            ),
        ]
    )


@app.cell
def _(con):
    ((first, last),) = con.sql("select min(on_date), max(on_date) from as_of").fetchall()
    day = mo.ui.date(start=first, stop=last, value=last, label="On the evening of")
    mo.vstack([mo.md("## What was said on a day\n\nOnly flights up to that day speak."), day])
    return (day,)


@app.cell
def _(con, day):
    said = con.sql("from as_of where on_date = ? order by p_event_50 desc nulls last", params=[day.value]).pl()
    shown(said.drop("on_date", "operator", "split", "departed_at"))
    return (said,)


@app.cell
def _(con):
    lives = con.sql("from exchanger_lives where n_flights >= 30 order by fouling_per_100_flights desc").pl()
    fastest = set(con.sql("select tail, pack, unit from fouling_fast").fetchall())
    figure = Figure(figsize=(8, 3.4), layout="constrained")
    axes = figure.subplots()
    rates = 100 * lives["fouling_per_100_flights"].to_numpy()
    names = [f"{r['tail']}-{r['pack']} unit {r['unit']}" for r in lives.to_dicts()]
    above = [(r["tail"], r["pack"], r["unit"]) in fastest for r in lives.to_dicts()]
    axes.bar(names, rates, color=[VERMILLION if a else GREY for a in above])
    axes.tick_params(axis="x", rotation=90, labelsize=7)
    axes.set(ylabel="% lost per 100 flights", title="Who fouls faster than the fleet (coloured: above its median)")
    mo.vstack([mo.md("## The fleet side by side"), figure])
    return (lives,)


@app.cell
def _(con):
    heard = con.sql("""
        select signal, sum(n_recorded) / sum(n_snapshots) as recorded, sum(n_believed) / sum(n_recorded) as believed
        from sensor_health group by signal order by believed
    """).pl()
    yielded = con.sql("""
        select
            tail, sum(n_legs)::int as legs, sum(n_admitted) / sum(n_legs) as admitted, mode(usual_reason) as reason
        from filter_yield group by tail order by admitted
    """).pl()
    mo.hstack([shown(heard, 16), shown(yielded, 16)], widths="equal")
    return heard, yielded


if __name__ == "__main__":
    app.run()
