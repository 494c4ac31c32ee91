"""Lesson 1, one flight: from what the recorder said to what was concluded of it."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(app_title="One flight")

with app.setup:
    import os
    from pathlib import Path

    import duckdb
    import marimo as mo
    from matplotlib.figure import Figure


@app.cell
def _():
    home = Path(os.environ.get("HDT_HOME", "hdt_home"))
    con = duckdb.connect(str(home / "catalog.duckdb"), read_only=True)
    _ = con.sql("set TimeZone = 'UTC'")
    return (con,)


@app.cell
def _(con):
    flown = con.sql("select operator, tail, pack, flight_id from legs where admitted order by departed_at, pack").pl()
    key = flown.row(-1)
    mo.md(f"# One flight\n\nPack {key[2]} of {key[1]}, flight {key[3]}: the last that was fit to calibrate from.")
    return (key,)


@app.cell
def _(con, key):
    of_flight = "where operator = ? and tail = ? and pack = ? and flight_id = ?"
    samples = con.sql(
        f"select time_utc, phase, altitude_m, hx_in_k, hx_out_k, ram_door_open, nominal from tables.legs_samples"
        f" {of_flight} order by time_utc",
        params=list(key),
    ).pl()
    verdict = con.sql(f"select admitted, reason, n_samples, n_nominal from legs {of_flight}", params=list(key)).pl()
    return of_flight, samples, verdict


@app.function
def drawn(samples) -> Figure:
    """Both temperatures of the exchanger's bleed side; samples that the twin looks at are dots."""
    figure = Figure(figsize=(8, 3), layout="constrained")
    axes = figure.subplots()
    for name, label in (("hx_in_k", "into the exchanger"), ("hx_out_k", "out of it")):
        axes.plot(samples["time_utc"].to_list(), samples[name].to_list(), label=label, lw=1)
        steady = samples.filter("nominal")
        axes.plot(steady["time_utc"].to_list(), steady[name].to_list(), ".", color="black", ms=4)
    axes.set(ylabel="K", title="What the recorder said (dots: steady cruise)")
    axes.legend(frameon=False)
    return figure


@app.cell
def _(samples, verdict):
    mo.vstack([drawn(samples), mo.md("**The leg filter** asks whether the flight may teach anything:"), verdict])


@app.cell
def _(con, key, of_flight):
    compared = con.sql(
        f"select signal, kind, round(mean, 3) as mean, round(sd, 3) as sd, unit from residuals {of_flight}"
        " order by 1, 2",
        params=list(key),
    ).pl()
    health = con.sql(
        f"select parameter, round(value, 4) as value, round(sd, 4) as sd, unit, status"
        f" from health_parameters {of_flight} order by 1",
        params=list(key),
    ).pl()
    mo.vstack(
        [
            mo.md("**The model** as built says what should have been measured; the difference is a residual:"),
            compared,
            mo.md("**The twin** turns it into health, with a standard deviation and a status for each:"),
            health,
        ]
    )


if __name__ == "__main__":
    app.run()
