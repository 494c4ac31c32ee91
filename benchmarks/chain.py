"""The nightly chain on frames in memory, step by step: the same functions in the same order, without files.

A step names what it reads, so a change of one function makes again only what follows from it.
"""

from collections.abc import Callable, Iterable
from inspect import signature
from typing import Any

import polars as pl

from hdt_core.alerts.alerts import raise_alerts
from hdt_core.calibration.calibrate import calibrate as fit
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.flight import admission
from hdt_core.flight.admission import leg_indicators
from hdt_core.flight.control_schedules import learn_schedules
from hdt_core.flight.legs import baseline_flights, judge_legs
from hdt_core.health.features import features as describe
from hdt_core.health.residuals import residuals as compare
from hdt_core.health.sensor_checks import cross_checks as testify
from hdt_core.margin.exchanger_demand import CRITICAL, exchanger_demand
from hdt_core.prognosis.feature_rows import MARGIN_FEATURES
from hdt_core.prognosis.fleet_record import FleetRecord
from hdt_core.prognosis.service import update_model
from hdt_core.records.keys import PACK
from hdt_core.tracking.track import track
from pipelines.learned import shipped_base
from pipelines.versions import records_until

Tables = dict[str, Any]
RECORD = ("snapshots", "maintenance", "messages")
"""What a chain begins with: snapshots as the raw stage stores them, and the two logs."""


def legs(snapshots: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame) -> Tables:
    verdicts, samples = judge_legs(snapshots)
    return {"verdicts": verdicts, "samples": samples}


def admit_fleet(
    verdicts: pl.DataFrame,
    samples: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    health: pl.DataFrame | None = None,
) -> pl.DataFrame:
    """Legs with the reasons of the second level, by the baseline of the same fleet."""
    norm = admission.learn_baseline(verdicts, samples, maintenance, messages)
    return admission.admit(norm, verdicts, leg_indicators(samples, norm), maintenance, messages, health)


def calibrate(
    verdicts: pl.DataFrame, samples: pl.DataFrame, maintenance: pl.DataFrame, messages: pl.DataFrame
) -> Tables:
    """Calibrate from each tail's commissioning window and the log entries up to its end."""
    within = pl.col("flight_id").is_in(baseline_flights(verdicts))
    verdicts = verdicts.filter(within)
    samples = samples.filter(within)
    logs = [records_until(log, verdicts) for log in (maintenance, messages)]
    norm = admission.learn_baseline(verdicts, samples, *logs)
    admitted = admission.admit(norm, verdicts, leg_indicators(samples, norm), *logs)
    return {"norm": norm, "dsm": fit(samples, admitted, logs[0]), "laws": learn_schedules(samples)}


def estimate(samples: pl.DataFrame, dsm: Any) -> Tables:
    return {"alone": estimate_flights(samples, dsm)}


def follow(alone: pl.DataFrame, maintenance: pl.DataFrame, dsm: Any) -> Tables:
    return {"health": track(alone, maintenance, dsm).health}


def admit(
    norm: Any,
    verdicts: pl.DataFrame,
    samples: pl.DataFrame,
    maintenance: pl.DataFrame,
    messages: pl.DataFrame,
    health: pl.DataFrame,
    alone: pl.DataFrame,
) -> Tables:
    signs = leg_indicators(samples, norm)
    return {"admitted": admission.admit(norm, verdicts, signs, maintenance, messages, health, alone)}


def margin(samples: pl.DataFrame, dsm: Any, laws: Any) -> Tables:
    return {"margin": exchanger_demand(samples, dsm, laws), "witnesses": testify(samples, laws)}


def features(
    health: pl.DataFrame,
    alone: pl.DataFrame,
    samples: pl.DataFrame,
    verdicts: pl.DataFrame,
    maintenance: pl.DataFrame,
    dsm: Any,
    margin: pl.DataFrame,
    witnesses: pl.DataFrame,
) -> Tables:
    """Compute features and add each flight's demand."""
    compared = compare(samples, alone, dsm)
    own = {"twin_flights": alone, "cross_checks": witnesses, "demand": margin}
    described = describe(health, compared, verdicts, maintenance, **own)
    key = [*PACK, "flight_id"]
    demands = margin.select(*key, *(c for c in (*CRITICAL, *MARGIN_FEATURES) if c not in described.columns))
    return {"features": described.join(demands, on=key, how="left", maintain_order="left")}


def alert(features: pl.DataFrame, maintenance: pl.DataFrame) -> Tables:
    return {"alerts": raise_alerts(features, maintenance)}


def foretell(features: pl.DataFrame, messages: pl.DataFrame, maintenance: pl.DataFrame) -> Tables:
    """Predict each tail by models trained on the other tails up to the month's start."""
    record = FleetRecord(features, messages, maintenance)
    return {"lives": record.lives(), "prognoses": update_model(shipped_base(), None, record).prognoses}


STEPS: tuple[Callable[..., Tables], ...] = (
    legs, calibrate, estimate, follow, admit, margin, features, alert, foretell,
)  # fmt: skip

UP_TO_ALERTS = tuple(step for step in STEPS if step not in (admit, foretell))


def run(tables: Tables, steps: Iterable[Callable[..., Tables]] = STEPS) -> Tables:
    """Run the steps on a record (`RECORD`); each step's arguments name the tables it reads."""
    tables = dict(tables)
    for step in steps:
        tables |= step(**{name: tables[name] for name in signature(step).parameters})
    return tables
