"""Lesson 3, a component of your own: declare it once, let any estimator find its health."""

import marimo

__generated_with = "0.25.2"
app = marimo.App(app_title="A component of your own")

with app.setup:
    import marimo as mo
    import numpy as np
    import polars as pl

    from hdt_core.estimation import ExtendedKalman, NonlinearLeastSquares, UnscentedKalman
    from hdt_core.estimation.declared import declared_problem
    from hdt_core.physics.effectiveness import counterflow_effectiveness
    from hdt_core.physics.model import Param, PhysicsModel, Signal


@app.cell
def _():
    mo.md("""
    # A component of your own

    An oil cooler: one equation, its inputs, its output with the sensor's noise, and two parameters.
    *Design* is found once, when the cooler is new; *health* is followed from flight to flight.
    """)


@app.function
def oil_outlet_k(*, oil_capacity_w_k, oil_in_k, air_in_k, hc_ua_w_k, hc_fouling):
    """Oil temperature behind the cooler: conductance UA, of which fouling takes a share. [K]"""
    ntu = (1.0 - hc_fouling) * hc_ua_w_k / oil_capacity_w_k
    return oil_in_k - counterflow_effectiveness(ntu, 0.0) * (oil_in_k - air_in_k)


@app.cell
def _():
    cooler = PhysicsModel(
        name="hydraulic_cooler",
        inputs=(Signal("oil_capacity_w_k", "W/K"), Signal("oil_in_k", "K"), Signal("air_in_k", "K")),
        outputs=(Signal("oil_out_k", "K", sigma=0.1),),
        params=(
            Param("hc_ua_w_k", "W/K", 150.0, (20.0, 1000.0), "design"),
            Param("hc_fouling", "-", 0.0, (-0.25, 0.95), "health", drift=0.02),
        ),
        equations=oil_outlet_k,
    )
    return (cooler,)


@app.function
def made_up(fouling: float, n: int = 40) -> pl.DataFrame:
    """Samples of a cooler that has lost a share, with the sensor's noise."""
    rng = np.random.default_rng(3)
    given = {
        "oil_capacity_w_k": rng.uniform(180.0, 220.0, n),
        "oil_in_k": rng.uniform(320.0, 335.0, n),
        "air_in_k": rng.uniform(285.0, 300.0, n),
    }
    told = oil_outlet_k(**given, hc_ua_w_k=150.0, hc_fouling=fouling) + 0.1 * rng.standard_normal(n)
    return pl.DataFrame(given | {"oil_out_k": told})


@app.cell
def _(cooler):
    truth = 0.3
    record = {name: values.to_numpy() for name, values in made_up(truth).to_dict().items()}
    problem = declared_problem(cooler, ["hc_fouling"], record, {"oil_out_k": record["oil_out_k"]})
    rows = []
    for method in (NonlinearLeastSquares(), ExtendedKalman(), UnscentedKalman()):
        estimate = method.estimate(problem)
        rows.append((method.name, float(estimate.belief.mean[0]), float(estimate.belief.sd[0]), estimate.status))
    found = pl.DataFrame(rows, schema=["method", "hc_fouling", "sd", "status"], orient="row")
    mo.vstack([mo.md(f"The truth is {truth}; each method is asked the same question:"), found])


@app.cell
def _():
    mo.md("""
    To have it followed every night, name it in a package as `hdt.components` and say
    which columns of its files are which signal:
    `docs/howto-component.md` takes this cooler from its files to the report.
    """)


if __name__ == "__main__":
    app.run()
