"""How a stage becomes Dagster assets: a function from tables to tables, wired and checked from the declarations."""

import inspect
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import timedelta
from functools import partial
from typing import Any, NamedTuple

import dagster as dg
import polars as pl

from dagster_batched.materialization import CheckBeforeStorage
from hdt_core.tables import TABLES
from pipelines import partitions
from pipelines.assets.automation import condition_of
from pipelines.intake.broken_rows import store_broken_rows
from pipelines.lineage import FOLLOWED, MAKER, STAGE, Stage
from pipelines.partitions import PartitionScope
from pipelines.resources import Home
from pipelines.storage.headers import MEANINGS
from pipelines.storage.panics import panics_as_errors

_TEAMS = {"raw": "flight-data", "legs": "flight-data", "calibration": "thermal-models", "twin": "thermal-models",
          "residuals": "thermal-models", "features": "health-monitoring", "prognosis": "health-monitoring",
          "published": "maintenance-control"}  # fmt: skip
_TOOLS = {"calibration": "scipy", "twin": "numpy", "prognosis": "scikitlearn"}
"""What does the sums of a group; of the others Polars."""
_PARTITIONS = {"flight": partitions.AIRCRAFT_FLIGHTS, "aircraft": partitions.AIRCRAFT, "fleet": None}
CHECK, HONOURED = "honours_table", "has the declared columns, types, spans and a unique key"
FRESH = dg.FreshnessPolicy.time_window(fail_window=timedelta(hours=50), warn_window=timedelta(hours=26))
"""A night that brought nothing is a warning, two are a fault."""


def owners(group: str) -> list[str]:
    """Whom to ask about an asset of a group: who takes files in, who knows the models, who watches, who acts."""
    return [f"team:{_TEAMS[group]}"]


class StageResult(NamedTuple):
    """Frames, with what one table's materialization shows beside its counts: the first's, or that `on` says."""

    frames: tuple[pl.DataFrame, ...]
    metadata: dict[str, Any]
    on: int = 0


Frames = pl.DataFrame | tuple[pl.DataFrame, ...] | StageResult


def stage(fn: Callable[..., Frames]) -> dg.AssetsDefinition:
    """Make assets of a function that bears the name of a stage declared in `pipelines.lineage`.

    The function's arguments are named after the tables it reads; `scope` and `home` give it the run's cells and
    folders, with which it may read a part of its parents. It returns one frame a table, in the order of the stage's
    tables. Each is checked against its declaration before it is stored: a row that breaks it is set aside in
    quarantine, and where rows stand or fall together nothing is stored and what depends on it does not run.

    Raises
    ------
    ValueError
        Where an argument is a table whose changes would not make the stage stale.
    """
    own = STAGE[fn.__name__]
    wanted = list(inspect.signature(fn).parameters)
    first_line = inspect.getdoc(fn) or ""
    condition = condition_of(own)

    @dg.multi_asset(
        name=own.name,
        outs={t: _out(t, own, first_line, condition) for t in own.tables},
        deps=[dg.AssetKey(t) for t in _drawn(own, [p for p in wanted if p in TABLES])],
        partitions_def=_PARTITIONS[own.grain],
        check_specs=[
            dg.AssetCheckSpec(CHECK, asset=t, blocking=True, description=f"{t} {HONOURED}") for t in own.tables
        ],
        backfill_policy=dg.BackfillPolicy.single_run(),
        description=first_line,
        op_tags={"hdt/stage": own.group},
    )
    def run(context: dg.AssetExecutionContext, home: Home) -> Iterator[Any]:
        scope = PartitionScope.of(None if own.grain == "fleet" else list(context.partition_keys))
        offered: dict[str, Any] = {"scope": scope, "home": home}
        began = time.monotonic()
        with panics_as_errors():
            made = fn(**{p: offered[p] if p in offered else scope.read_table(home.store, p) for p in wanted})
        took = {"seconds": round(time.monotonic() - began, 3)}
        result, store, ledger = _as_result(made), home.store, home.ledger
        for place, (table, frame) in enumerate(zip(own.tables, result.frames, strict=True)):
            shown = result.metadata if place == result.on else {}
            keep = partial(store_broken_rows, store, ledger, scope, table)
            yield from _checked(table, frame, took, shown, keep)

    return run


def _as_result(made: Frames) -> StageResult:
    if isinstance(made, StageResult):
        return made
    return StageResult((made,) if isinstance(made, pl.DataFrame) else made, {})


def _drawn(own: Stage, read: list[str]) -> list[str]:
    """Tables from which the graph draws an arrow: those read as arguments, and parents read through the home."""
    lost = set(read) - FOLLOWED[own.name]
    if lost:
        raise ValueError(f"{own.name} reads {', '.join(sorted(lost))}, of which its lineage follows no change")
    makers = [MAKER[table].name for table in read]
    return [*read, *(parent for parent in own.parents if MAKER[parent].name not in makers)]


def _out(
    table: str, own: Stage, description: str, condition: dg.AutomationCondition[dg.AssetKey] | None
) -> dg.AssetOut:
    schema = TABLES[table].schema
    first = (inspect.getdoc(schema) or "").splitlines()[0]
    columns = [dg.TableColumn(n, str(c.dtype), description=MEANINGS[table][n]) for n, c in schema.columns().items()]
    return dg.AssetOut(
        group_name=own.group,
        owners=owners(own.group),
        kinds={"deltalake", _TOOLS.get(own.group, "polars")},
        automation_condition=condition,
        description=f"{first}\n\n{description}",
        code_version=own.tables[table].code,
        freshness_policy=FRESH if table == own.fresh else None,
        metadata={"dagster/column_schema": dg.TableSchema(columns=columns), "grain": TABLES[table].grain},
    )


def _checked(
    table: str,
    frame: pl.DataFrame,
    took: dict[str, float],
    shown: Mapping[str, Any],
    keep: Callable[[pl.DataFrame], None] = lambda _: None,
) -> Iterator[Any]:
    """What the check of a table says, and the rows to store; `keep` is given those that break the declaration.

    The check speaks of the run: how many rows of how many flights, and how long it `took`. What is stored is told by
    partition, so only what is `shown` goes with it.
    """
    frame = TABLES[table].conform(frame)
    sound, broken = TABLES[table].schema.parted(frame)
    faults = TABLES[table].schema.counted(broken, frame.height)
    refused = bool(faults) and (TABLES[table].whole or (TABLES[table].grain == "fleet" and not sound.height))
    says = "; ".join(faults) or f"{frame.height} rows, each as declared"
    told = "not stored: " if refused else "set aside in quarantine: " if faults else ""
    yield CheckBeforeStorage(
        check_name=CHECK,
        asset_key=table,
        passed=not faults,
        severity=dg.AssetCheckSeverity.ERROR if refused else dg.AssetCheckSeverity.WARN,
        description=told + says,
        metadata={"rows": frame.height, "faults": "; ".join(faults) or "none", **took, **_numbers(sound)},
    )
    if refused:
        raise dg.Failure(f"{table} breaks its declaration, so it was not stored: {says}")
    keep(broken)
    yield dg.Output(sound, output_name=table, metadata=shown)


def _numbers(frame: pl.DataFrame) -> dict[str, int]:
    counted = {"flight_id": "flights", "tail": "aircraft"}
    return {name: frame[c].n_unique() for c, name in counted.items() if c in frame.columns}
