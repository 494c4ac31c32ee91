"""Declared components against known truth: `python -m benchmarks.own_component [--fleets N] [--write]`.

Claim: whatever a unit's history, intervals of 90 % hold the true loss and the true remaining life in 85 to 95 %, no
unit lies five deviations off with the status `ok`, and remaining life is unbiased within 15 flights. Fleets of 24
sister fuel-oil exchangers (`benchmarks.fuel_oil_exchanger`), three of each history; a sister differs by 2 % as made and
wears at a rate of its own. `--write` puts the tables into docs/howto-component.md.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.fuel_oil_exchanger import EXCHANGER, LIFE_FLIGHTS, LIMIT, measured
from benchmarks.harness import DOCS, Texts, markdown, run
from hdt_core.alerts.component_alerts import component_features
from hdt_core.components import LINEAR, RESISTANCE, WearLaw, power_law
from hdt_core.flight.component_legs import component_samples
from hdt_core.physics.model import Array
from hdt_core.prognosis.component_life import component_prognoses
from hdt_core.prognosis.model import HORIZON
from hdt_core.robust import Z_90
from hdt_core.tables.twin import Residuals
from hdt_core.tracking.component_units import commission, unit_health

PAGE = DOCS / "howto-component.md"
HISTORIES = (
    "as new", "worn at entry", "washed, logged", "washed, on no log", "replaced, logged", "replaced, on no log",
    "outlet sensor 2.5 K off", "outlet sensor 2.5 K off later",
)  # fmt: skip
OF_EACH, FLIGHTS = 3, 200
UNIT_SD, BIAS_K = 0.02, 2.5
FAR_SD, FAR_FLIGHTS = 5.0, 10
"""A unit is far off where its error exceeds so many deviations on so many flights running."""
DISTANCES = ((0, 10), (10, 25), (25, 50), (50, 100), (100, 200))
"""Flights since a wash, or since the unit began."""
DECLARED = {"loss": LINEAR, "resistance": RESISTANCE, "square of the loss": power_law(0.5)}
"""What grows in proportion to flights."""
LAWS = tuple(DECLARED)
LAW_SEEDS = {law: number for number, law in enumerate(LAWS)}


def loss_at(law: WearLaw, grown: Array) -> Array:
    """Return the loss at which so much has grown."""
    amount = np.asarray(grown) ** law.power
    return amount / (1.0 + amount) if law.of_resistance else amount


def linear_at(law: WearLaw, loss: float) -> float:
    """Return what has grown at a loss."""
    return float(law.grown(np.array(loss))) if loss > 0.0 else 0.0


class Unit(NamedTuple):
    """Truth of one position over its flights: loss, size as made [W/K], flights left, flights since work; the
    work and its flight, whether it fails at last, and the flight from which its outlet's sensor is off."""

    history: str
    loss: Array
    size_w_k: Array
    left: Array
    since: Array
    done: tuple[str, int] | None
    fails: bool
    shifted_at: int


class Part(NamedTuple):
    """A unit as it was made: rate of what grows linearly, its amount at failure, and size. [1/flight], [-], [W/K]"""

    rate: float
    limit: float
    size_w_k: float


def make(rng: np.random.Generator, law: WearLaw) -> Part:
    """Draw a unit."""
    rate = float(rng.gamma(4.0, 0.25)) * linear_at(law, LIMIT.mean) / LIFE_FLIGHTS
    limit = linear_at(law, float(rng.normal(LIMIT.mean, LIMIT.unit_sd)))
    return Part(rate, limit, 950.0 * float(np.exp(UNIT_SD * rng.standard_normal())))


def fly(rng: np.random.Generator, history: str, law: WearLaw) -> Unit:
    """Simulate one position until its unit fails or the record ends."""
    part = make(rng, law)
    grown = linear_at(law, float(rng.uniform(0.08, 0.2))) if history == "worn at entry" else 0.0
    event_at = int(rng.integers(90, 150))
    is_worked_on = history.startswith(("washed", "replaced"))
    rows: list[tuple[float, float, float, int]] = []
    last = 0
    for flight in range(FLIGHTS):
        if flight == event_at and is_worked_on:
            last = flight
            left_share = float(rng.uniform(0.1, 0.5)) if history.startswith("washed") else 0.0
            grown = linear_at(law, left_share * float(loss_at(law, np.array(grown))))
            part = part if history.startswith("washed") else make(rng, law)
        rows.append((grown, part.size_w_k, max((part.limit - grown) / part.rate, 0.0), flight - last))
        if grown >= part.limit:
            break
        grown += part.rate
    linear, size_w_k, left, since = (np.array(column) for column in zip(*rows, strict=True))
    action = "CLEANED" if history.startswith("washed") else "REPLACED"
    done = (action, event_at) if last else None
    shifted_at = event_at if history.endswith("later") else 0
    return Unit(history, loss_at(law, linear), size_w_k, left, since, done, bool(left[-1] == 0.0), shifted_at)


def fleet_of(rng: np.random.Generator, law: str) -> list[Unit]:
    """Simulate a fleet: so many units of each history."""
    return [fly(rng, history, DECLARED[law]) for history in HISTORIES for _ in range(OF_EACH)]


def record_of(rng: np.random.Generator, units: list[Unit]) -> pl.DataFrame:
    """Simulate the fleet's samples, in the store's long form."""
    parts = []
    for number, unit in enumerate(units):
        is_off = unit.history.startswith("outlet") & (np.arange(len(unit.loss)) >= unit.shifted_at)
        values = measured(rng, unit.loss, unit.size_w_k, BIAS_K * is_off[:, None])
        flight, sample = (i.ravel() for i in np.indices(next(iter(values.values())).shape))
        keys = {"unit": np.full(flight.size, number), "flight": flight, "sample": sample}
        parts.append(pl.DataFrame(keys | {name: v.ravel() for name, v in values.items()}))
    time = pl.datetime(2024, 1, 1, 8, time_zone="UTC") + pl.duration(days="flight", minutes="sample")
    rows = pl.concat(parts)
    names = [c for c in rows.columns if c not in ("unit", "flight", "sample")]
    named = rows.select(*_names(), *names, component=pl.lit("FOH"), flight_id=_flight(), time_utc=time)
    return named.unpivot(names, index=[c for c in named.columns if c not in names], variable_name="signal")


def _names() -> tuple[pl.Expr, ...]:
    tail = pl.format("A-{}", pl.col("unit").cast(pl.String).str.zfill(3))
    return pl.lit("OPA").alias("operator"), tail.alias("tail"), pl.lit(1, pl.Int32).alias("pack")


def _flight() -> pl.Expr:
    return pl.format("F-{}", pl.col("flight").cast(pl.String).str.zfill(3))


def logs_of(units: list[Unit]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return messages of the units that failed, and the maintenance log."""
    fails = [(u, len(unit.loss) - 1) for u, unit in enumerate(units) if unit.fails]
    at = pl.datetime(2024, 1, 1, 9, time_zone="UTC") + pl.duration(days="flight")
    schema = {"unit": pl.Int64, "flight": pl.Int64}
    messages = pl.DataFrame(fails, schema=schema, orient="row").select(
        *_names(), code=pl.lit(EXCHANGER.message_code), flight_id=_flight(), text=pl.lit(""), message_time=at
    )
    done = [
        (u, unit.done[1], unit.done[0]) for u, unit in enumerate(units) if unit.done and "no log" not in unit.history
    ]
    work = pl.DataFrame(done, schema=schema | {"action": pl.String}, orient="row").select(
        *_names(), component=pl.lit("FOH"), action="action", finding=pl.lit("FOULED"), reference=pl.lit(""),
        done_on=pl.date(2023, 12, 31) + pl.duration(days="flight"),
    )  # fmt: skip
    return messages, work


def judge(rng: np.random.Generator, law: str) -> pl.DataFrame:
    """Simulate a fleet and estimate it; return truth beside the estimates, one row a flight and declared law."""
    units = fleet_of(rng, law)
    signals = record_of(rng, units)
    messages, work = logs_of(units)
    legs, design = commission(signals, work, EXCHANGER)
    _, (health, _) = unit_health(component_samples(signals, EXCHANGER), legs, design, work, EXCHANGER)
    features = component_features(health, Residuals.create_empty(), legs, work, EXCHANGER)
    columns = ["tail", "flight_id"]
    truth = pl.concat(
        pl.DataFrame({"unit": u, "flight": np.arange(len(x.loss)), "history": x.history, "true": x.loss, "left": x.left,
                      "since": x.since})
        for u, x in enumerate(units)
    )  # fmt: skip
    left = pl.col("left").clip(0.0, HORIZON)
    rows = truth.select(_names()[1], _flight().alias("flight_id"), "history", "true", left, "since")
    estimates = features.select(*columns, "loss", "loss_sd", "loss_status")
    rows = rows.join(estimates, on=columns, validate="1:1")
    parts = []
    for name, declared_law in {"none": None, law: DECLARED[law]}.items():
        lives = component_prognoses(features, messages, work, replace(EXCHANGER, wear_law=declared_law))
        lives = lives.select(*columns, "rul_low", "rul_flights", "rul_high", declared=pl.lit(name))
        parts.append(rows.join(lives, on=columns, validate="1:1"))
    return pl.concat(parts)


def histories(rows: pl.DataFrame) -> str:
    """Tabulate the loss and the remaining life of units of each history, the law of wear declared."""
    is_off = (_error().abs() > FAR_SD * pl.col("loss_sd")) & (pl.col("loss_status") == "ok")
    far = is_off.cast(pl.Int64).rolling_sum(FAR_FLIGHTS).over("fleet", "tail").max() >= FAR_FLIGHTS
    own = rows.filter(pl.col("declared") != "none")
    lines = [["history", "units", "mean error of the loss", "loss covered", "five deviations off", "life covered",
              "life's bias, flights"]]  # fmt: skip
    for history in HISTORIES:
        part = own.filter(history=history)
        n_far = sum(unit.select(far).item() for _, unit in part.group_by("fleet", "tail", maintain_order=True))
        covered = (_error().abs() < Z_90 * pl.col("loss_sd")).mean()
        values = part.select(
            n=pl.struct("fleet", "tail").n_unique(), error=_error().mean(), covered=covered, **_lives()
        )
        n, error, loss_covered, life_covered, bias = values.row(0)
        lines.append([history, str(n), f"{error:+.3f}", f"{loss_covered:.2f}", str(n_far), f"{life_covered:.2f}",
                      f"{bias:+.0f}"])  # fmt: skip
    return markdown(lines)


def distances(rows: pl.DataFrame) -> str:
    """Tabulate the remaining life by the distance from a wash, a replacement or the record's begin."""
    own = rows.filter(pl.col("declared") != "none")
    lines = [["flights since", *(f"{low} to {high}" for low, high in DISTANCES)]]
    for name, prefix in {"a wash": "washed", "a replacement": "replaced", "the unit as new": "as new"}.items():
        kind = own.filter(pl.col("history").str.starts_with(prefix))
        cells = []
        for low, high in DISTANCES:
            at = kind.filter(pl.col("since").is_between(low, high, closed="left"), _is_after_work(prefix))
            life_covered, bias = at.select(**_lives()).row(0)
            cells.append(f"{bias:+.0f}, {life_covered:.2f}" if at.height else "-")
        lines.append([name, *cells])
    return markdown(lines)


def _is_after_work(prefix: str) -> pl.Expr:
    """Flag the flights after a position's work; all of one without any."""
    began = (pl.col("since") == 0).cum_sum().over("fleet", "tail")
    return began > (0 if prefix == "as new" else 1)


def laws(rows: dict[str, pl.DataFrame]) -> str:
    """Tabulate the remaining life by the law of the true wear and the declared one."""
    lines = [
        ["true wear is linear in", "declared", "life covered", "bias, flights", "covered, first 50", "bias, first 50"]
    ]
    for law, own in rows.items():
        for name in ("none", law):
            part = own.filter(declared=name)
            covered, bias = part.select(**_lives()).row(0)
            early_covered, early_bias = part.filter(pl.col("since") < 50).select(**_lives()).row(0)
            lines.append([law, name, f"{covered:.2f}", f"{bias:+.0f}", f"{early_covered:.2f}", f"{early_bias:+.0f}"])
    return markdown(lines)


def _error() -> pl.Expr:
    return pl.col("loss") - pl.col("true")


def _lives() -> dict[str, pl.Expr]:
    is_covered = (pl.col("rul_low") <= pl.col("left")) & (pl.col("left") <= pl.col("rul_high"))
    return {"life_covered": is_covered.mean(), "life_bias": (pl.col("rul_flights") - pl.col("left")).mean()}


def judge_fleets(law: str, fleets: int) -> pl.DataFrame:
    """Judge so many fleets of one true law."""
    seeds = [[LAW_SEEDS[law], fleet] for fleet in range(fleets)]
    parts = (judge(np.random.default_rng(seed), law).with_columns(fleet=pl.lit(seed[1])) for seed in seeds)
    return pl.concat(parts)


def main(fleets: int = 34, other_fleets: int = 4) -> Texts:
    """Judge fleets whose wear is linear in the loss, and fewer of each other law."""
    rows = {law: judge_fleets(law, fleets if law == "loss" else other_fleets) for law in LAWS}
    yield "own component", histories(rows["loss"])
    yield "own component by distance", distances(rows["loss"])
    yield "own component by law", laws(rows)


if __name__ == "__main__":
    run(main, page=PAGE)
