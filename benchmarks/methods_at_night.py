"""The methods by name in the night: `python -m benchmarks.methods_at_night [--flights N] [--methods M ...] [--write]`.

Six simulated aircraft; `estimators.toml` of a home names one method for both parts of the pack, design and health; one
night calibrates and tracks them, and the catalog is compared with the simulator's truth. CPU is the whole night's.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import polars as pl

from benchmarks.harness import Texts, markdown, run
from benchmarks.scale import measured
from hdt_core.components.pack import CC, HX
from hdt_core.records.keys import FLIGHT_PACK
from hdt_core.robust import Z_90
from hdt_core.simulate.design import FleetSettings
from pipelines.intake.simulated import write_fleet
from pipelines.storage.catalog import connect

METHODS = ("nls", "ekf", "ukf", "pso", "pinn", "differential_evolution")
TRUTH = {HX.code: 1.0 - pl.col("apparent_ua_ratio"), CC.code: pl.col("cc_eff_loss")}
SEED = 311


def fly(landing: Path, home: Path, method: str) -> float:
    """Run the first night of a home by one method; return its processor time. [s]"""
    home.mkdir()
    lines = "".join(f'{part.code} = "{method}"\n' for part in (HX, CC))
    (home / "estimators.toml").write_text(lines, encoding="utf-8")
    return measured(landing, home)["cpu_s"]


def losses(home: Path, truth: pl.DataFrame) -> pl.DataFrame:
    """Read each flight's filtered losses from the catalog, with the true ones, `truth`."""
    query = "select * from health_parameters where parameter in ($hx, $cc)"
    with connect(home) as con:
        rows = pl.from_arrow(con.sql(query, params={"hx": HX.loss, "cc": CC.loss}).to_arrow_table())
    assert isinstance(rows, pl.DataFrame)
    true_losses = pl.concat(
        truth.select(*FLIGHT_PACK, component=pl.lit(code), truth=loss) for code, loss in TRUTH.items()
    )
    known = rows.filter(pl.col("value").is_not_null())
    keys = [*FLIGHT_PACK, "component"]
    return known.join(true_losses, on=keys, validate="1:1").sort(keys)


def designs(home: Path) -> dict[str, str]:
    """Return what made the design of each part, by its code."""
    query = (
        "select component, string_agg(distinct estimator, '; ' order by estimator) from design_parameters group by 1"
    )
    with connect(home) as con:
        return dict(con.execute(query).fetchall())


def compare(rows: pl.DataFrame, optimum: pl.DataFrame) -> list[str]:
    """Format error, deviation, coverage, share `ok` and distance from least squares of one part's losses."""
    error = (rows["value"] - rows["truth"]).abs()
    covered = (error < Z_90 * rows["sd"]).mean()
    keys = [*FLIGHT_PACK, "component"]
    pairs = rows.join(optimum, on=keys, suffix="_nls", validate="1:1")
    apart_sd = ((pairs["value"] - pairs["value_nls"]) / pairs["sd_nls"]).abs()
    is_ok = (rows["status"] == "ok").mean()
    return [f"{error.mean():.4f}", f"{rows['sd'].mean():.4f}", f"{covered:.2f}", f"{is_ok:.3f}",
            f"{apart_sd.median():.3f}, {apart_sd.max():.2f}"]  # fmt: skip


def main(flights: int = 60, tails: int = 3, methods: tuple[str, ...] = METHODS) -> Texts:
    """Fly a night by each method over two operators with so many aircraft each; least squares is the first."""
    head = ["part", "method", "design by", "error of the loss", "its sd", "coverage of 90 %", "`ok`",
            "off nls [sd]: median, worst", "CPU of the night [s]"]  # fmt: skip
    lines = list[list[str]]()
    with TemporaryDirectory() as name:
        folder = Path(name)
        list(write_fleet(folder, SEED, FleetSettings(operators=2, tails=tails, flights=flights, cpl_share=0.0)))
        truth = pl.read_parquet(folder / "truth/health.parquet")
        optimum = pl.DataFrame()
        for method in ("nls", *(m for m in methods if m != "nls")):
            home = folder / method
            cpu_s = fly(folder / "landing", home, method)
            rows = losses(home, truth)
            optimum = rows if method == "nls" else optimum
            made_by = designs(home)
            for part in (HX, CC):
                own = rows.filter(component=part.code)
                figures = compare(own, optimum)
                lines.append([part.name, method, made_by[part.code], *figures, f"{cpu_s:.0f}"])
    by_part = sorted(lines, key=lambda line: line[0] != HX.name)
    yield "methods at night", markdown([head, *by_part])


if __name__ == "__main__":
    run(main)
