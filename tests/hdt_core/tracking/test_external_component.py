"""A component as an outsider declares it: compressors of eight ships, worn at entry, replaced, washed."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from hdt_core.alerts.component_alerts import component_features
from hdt_core.components import Channel, Component, Limit, Record
from hdt_core.flight.component_legs import component_samples
from hdt_core.health.residuals import component_residuals
from hdt_core.physics.model import Param, PhysicsModel, Signal
from hdt_core.prognosis.component_life import component_prognoses
from hdt_core.records.keys import LEG
from hdt_core.tracking.component_units import commission, pack_models, unit_health


def exit_k(*, inlet_k, pressure_ratio, nav_efficiency, nav_loss):
    """Exit temperature of a compressor of so much isentropic efficiency, of which wear takes a share. [K]"""
    return inlet_k * (1.0 + (pressure_ratio ** (0.4 / 1.4) - 1.0) / (nav_efficiency * (1.0 - nav_loss)))


MODEL = PhysicsModel(
    name="service_air_compressor",
    inputs=(Signal("inlet_k", "K"), Signal("pressure_ratio", "-")),
    outputs=(Signal("exit_k", "K", sigma=1.0),),
    params=(
        Param("nav_efficiency", "-", 0.75, (0.3, 0.95), "design"),
        Param("nav_loss", "-", 0.0, (-0.3, 0.7), "health", drift=0.002),
    ),
    equations=exit_k,
)
NAVAL = Component(
    "NAV", "service air compressor", "Efficiency lost", MODEL, "nav_loss", Limit(0.25, 0.04, 0.03), 300.0, "Wash it",
    record=Record((Channel("inlet", "inlet_k", "K", ""), Channel("ratio", "pressure_ratio", "-", ""),
                   Channel("exit", "exit_k", "K", ""))),
)  # fmt: skip
SPREAD = replace(NAVAL, model=replace(MODEL, params=(
    replace(MODEL.params[0], sd=0.04), replace(MODEL.params[1], unit_sd=0.05))))  # fmt: skip
SHIPS = 8
VOYAGES = 160
SAMPLES = 6
RENEWED = 80
WASHED = 50
UNIT_SD = 0.05


SHIP = {"operator": pl.lit("NVY"), "tail": pl.format("S-{}", "ship"), "pack": pl.lit(1, pl.Int32)}


def simulate_wear(rng: np.random.Generator, ship: int) -> np.ndarray:
    """Wear of one ship's compressor: odd ones are replaced, two in four washed, and every other wash goes unlogged."""
    wear = np.cumsum(np.full(VOYAGES, rng.gamma(4.0, 0.25) * 0.288 / 300)) + (0.0, 0.0, 0.04, 0.08)[ship // 2]
    if ship // 2 % 2:
        wear[WASHED:] -= rng.uniform(0.5, 0.9) * wear[WASHED]
    if ship % 2:
        wear[RENEWED:] -= wear[RENEWED]
    return wear


def record(rng: np.random.Generator, wear: np.ndarray, offset: np.ndarray) -> pl.DataFrame:
    """Samples in the store's long form of ships whose wear and unit's ln efficiency are (ships, voyages)."""
    shape = (*wear.shape, SAMPLES)
    inlet = rng.normal(290.0, 6.0, shape)
    ratio = rng.uniform(2.5, 4.0, shape)
    built = 0.75 * np.exp(offset + 0.006 * rng.standard_normal(offset.shape))
    outlet = exit_k(inlet_k=inlet, pressure_ratio=ratio, nav_efficiency=built[..., None],
                    nav_loss=1.0 - np.exp(-wear[..., None])) + rng.normal(0.0, 1.0, shape)  # fmt: skip
    ship, voyage, sample = (i.ravel() for i in np.indices(shape))
    keys = pl.DataFrame({"ship": ship, "voyage": voyage, "sample": sample}).select(
        **SHIP, component=pl.lit("NAV"),
        flight_id=pl.format("V-{}", pl.col("voyage").cast(pl.String).str.zfill(3)),
        time_utc=pl.datetime(2024, 1, 1, 8, time_zone="UTC") + pl.duration(days="voyage", minutes="sample"),
    )  # fmt: skip
    values = {"inlet_k": inlet.ravel(), "pressure_ratio": ratio.ravel(), "exit_k": outlet.ravel()}
    return keys.with_columns(**values).unpivot(list(values), index=keys.columns, variable_name="signal")


def log_of(done: list[tuple[int, str, int]]) -> pl.DataFrame:
    """Work on a ship's compressor before the voyage of that number."""
    return pl.DataFrame(done, schema=["ship", "action", "day"], orient="row").select(
        "action", operator=pl.lit("NVY"), tail=pl.format("S-{}", "ship"), pack=1, component=pl.lit("NAV"),
        done_on=pl.date(2023, 12, 31) + pl.duration(days="day"), finding=pl.lit("FOULED"), reference=pl.lit(""),
    )  # fmt: skip


@pytest.fixture(scope="module")
def fleet() -> tuple[pl.DataFrame, pl.DataFrame, np.ndarray]:
    """Samples of all ships, the log, and the true loss (ships, voyages)."""
    rng = np.random.default_rng(7)
    wear = np.array([simulate_wear(rng, ship) for ship in range(SHIPS)])
    unit = np.arange(VOYAGES)[None, :] >= np.where(np.arange(SHIPS) % 2, RENEWED, VOYAGES)[:, None]
    offset = np.take_along_axis(UNIT_SD * rng.standard_normal((SHIPS, 2)), unit.astype(int), axis=1)
    done = [(s, "REPLACED", RENEWED) for s in range(1, SHIPS, 2)] + [(s, "CLEANED", WASHED) for s in (2, 7)]
    return record(rng, wear, offset), log_of(done), 1.0 - np.exp(-wear)


@pytest.mark.parametrize("component", [NAVAL, SPREAD], ids=["spread not declared", "spread declared"])
def test_intervals_cover_true_loss(fleet, component):
    signals, log, true = fleet
    legs, design = commission(signals, log, component)
    _, (health, _) = unit_health(component_samples(signals, component), legs, design, log, component)
    ordered = health.filter(parameter="nav_loss").sort("tail", "departed_at")
    off, sd = (ordered[c].to_numpy().reshape(true.shape) for c in ("value", "sd"))
    off = off - true
    assert set(ordered["status"]) == {"ok"}
    assert (np.abs(off) < 1.645 * sd).mean() > 0.85
    assert np.abs(off / sd).max() < 5.0
    assert np.abs(off).mean() < 0.02


def lives(rng: np.random.Generator, voyages: int, life: float) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Wear and offset of one ship's units, and the voyages that end in a failure, each unit at a loss of its own."""
    wear = np.zeros(voyages)
    offset = np.zeros(voyages)
    failures = []
    level = rng.choice([0.0, 0.04, 0.08])
    rate = rng.gamma(4.0, 0.25) * 0.288 / life
    limit = rng.normal(0.25, 0.03)
    own = UNIT_SD * rng.standard_normal()
    for voyage in range(voyages):
        wear[voyage] = level
        offset[voyage] = own
        level += rate * rng.gamma(2.0, 0.5)
        if 1.0 - np.exp(-wear[voyage]) >= limit:
            failures.append(voyage)
            level = 0.0
            rate = rng.gamma(4.0, 0.25) * 0.288 / life
            limit = rng.normal(0.25, 0.03)
            own = UNIT_SD * rng.standard_normal()
    return wear, offset, failures


def test_remaining_life_is_unbiased():
    """Thirty ships of three seeds: 4 to 9 voyages, 89 to 93 % covered."""
    rng = np.random.default_rng(1)
    voyages = 400
    life = 200.0
    units = [lives(rng, voyages, life) for _ in range(16)]
    wear, offset = (np.array(x) for x in list(zip(*units, strict=True))[:2])
    ends = [(ship, at) for ship, (_, _, failures) in enumerate(units) for at in failures]
    component = replace(SPREAD, message_code="NAV01", life_flights=life)
    signals = record(rng, wear, offset)
    log = log_of([(ship, "REPLACED", at + 1) for ship, at in ends])
    messages = pl.DataFrame(ends, schema=["ship", "day"], orient="row").select(
        **SHIP, code=pl.lit("NAV01"),
        flight_id=pl.format("V-{}", pl.col("day").cast(pl.String).str.zfill(3)), text=pl.lit(""),
        message_time=pl.datetime(2024, 1, 1, 8, 6, time_zone="UTC") + pl.duration(days="day"),
    )  # fmt: skip
    legs, design = commission(signals, log, component)
    samples = component_samples(signals, component)
    flights, (health, _) = unit_health(samples, legs, design, log, component)
    residuals = pl.concat(
        component_residuals(own.filter("nominal").join(flights, on=LEG, how="semi"), flights, model, component.code)
        for model, _, own in pack_models(samples, design, component)
    )
    features = component_features(health, residuals, legs, log, component)
    rows = component_prognoses(features, messages, log, component)
    number = {"ship": pl.col("tail"), "voyage": pl.col("flight_id")}
    at = rows.select(text.str.slice(2).cast(int).alias(name) for name, text in number.items()).rows()
    ahead = [[end - v for s, end in ends if s == ship and end >= v] for ship, v in at]
    remaining = np.array([min(one, default=np.nan) for one in ahead])
    late = remaining <= 100
    error = rows["rul_flights"].to_numpy()[late] - remaining[late]
    low = rows["rul_low"].to_numpy()[late]
    high = rows["rul_high"].to_numpy()[late]
    covered = (low <= remaining[late]) & (remaining[late] <= high)
    assert late.sum() > 400
    assert abs(error.mean()) < 15.0
    assert 0.85 < covered.mean() < 0.96
