"""Alerts and remaining life by the reserve of the type: each figure pooled, and the lowest and highest of one type."""

from typing import NamedTuple

import numpy as np
import polars as pl

from benchmarks.alerts import Tally, figures_of, together
from benchmarks.fleets import RESERVE_CLASSES
from benchmarks.harness import markdown
from hdt_core.prognosis.metrics import score_prognoses


class TypeRecord(NamedTuple):
    """One simulated type: its class of reserve, its alerts, and its exchangers' prognoses with outcomes."""

    reserve: str
    alerts: Tally
    prognoses: pl.DataFrame


def figures(alerts: Tally, prognoses: pl.DataFrame) -> dict[str, float]:
    """Compute the figures of one type or of several together."""
    exchanger = figures_of(alerts, "HX")
    scores = score_prognoses(prognoses)
    return {
        "alerted": exchanger["alerted"],
        "right within 200": exchanger["right within 200"],
        "alerts without own cause in 1,000": 1000.0 * float((~alerts.alerts["own"]).sum()) / alerts.flights,
        "score over a constant's": 1.0 - scores.get("interval_skill", np.nan),
        "coverage": scores.get("coverage", np.nan),
        "Brier skill, 50": scores.get("brier_skill", np.nan),
        "AUC, 50": scores.get("auc", np.nan),
    }


def table(types: list[TypeRecord]) -> str:
    """Return a row for each class of reserve."""
    lines: list[list[str]] = []
    for reserve in RESERVE_CLASSES:
        members = [t for t in types if t.reserve == reserve]
        if not members:
            continue
        alerts = together([t.alerts for t in members])
        pooled = figures(alerts, pl.concat([t.prognoses for t in members], how="diagonal_relaxed"))
        single = [figures(t.alerts, t.prognoses) for t in members]
        cells = [_with_range(value, [one[name] for one in single]) for name, value in pooled.items()]
        if not lines:
            lines.append(["reserve", "types", "failures", *pooled])
        failures = alerts.failures.filter(component="HX").height
        lines.append([reserve, str(len(members)), str(failures), *cells])
    return markdown(lines)


def _with_range(pooled: float, single: list[float]) -> str:
    return f"{pooled:.3g} ({np.nanmin(single):.3g} to {np.nanmax(single):.3g})"
