"""Build Dagster assets of a stage's function, wired, checked and automated from its declaration."""

import inspect
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import timedelta
from functools import partial
from typing import Any, NamedTuple

import dagster as dg
import polars as pl

from dagster_batched.runs import CheckBeforeStorage
from hdt_core.tables import TABLES
from pipelines.intake.faults import panics_as_errors
from pipelines.lineage import MAKER, STAGE, UPSTREAM, Stage
from pipelines.resources import (
    AIRCRAFT,
    AIRCRAFT_FLIGHTS,
    Home,
    Made,
    PartitionScope,
    store_broken_rows,
    storing,
    tables_set_aside,
)
from pipelines.storage.view_headers import MEANINGS

PUBLISHED = "9_catalog_report"
"""Asset group of the catalog and the report."""
_GROUPS = {
    "raw": ("1_recorder_files", "flight-data"), "record": ("2_record", "flight-data"),
    "legs": ("3_flight_legs", "flight-data"), "calibration": ("4_system_model", "thermal-models"),
    "twin": ("5_twin", "thermal-models"), "residuals": ("6_residuals", "thermal-models"),
    "features": ("7_health_alerts", "health-monitoring"), "prognosis": ("8_prognosis", "health-monitoring"),
    "published": (PUBLISHED, "maintenance-control"),
}  # fmt: skip
"""Label of each group in Dagster's graph, 16 characters at most, in the chain's order, and the team that owns it."""
_TOOLS = {"calibration": "scipy", "twin": "numpy", "prognosis": "scikitlearn"}
"""Library shown for a group; Polars for the others."""
_PARTITIONS = {"flight": AIRCRAFT_FLIGHTS, "aircraft": AIRCRAFT, "fleet": None}
CHECK, CHECK_MEANING = "honours_table", "has the declared columns, types, spans and a unique key"
FRESHNESS = dg.FreshnessPolicy.time_window(fail_window=timedelta(hours=50), warn_window=timedelta(hours=26))
"""Warn after one night without data, fail after two."""


def group_of(stage: str) -> dict[str, Any]:
    """Return the group of a stage's assets and its owner, as Dagster takes them."""
    label, team = _GROUPS[stage]
    return {"group_name": label, "owners": [f"team:{team}"]}


class StageResult(NamedTuple):
    """Frames, with metadata for the materialization of the first table.

    `inputs_changed` where the ledger lists files otherwise than before, for they were not read as registered.
    """

    frames: tuple[pl.DataFrame, ...]
    metadata: dict[str, Any]
    inputs_changed: bool = False


Frames = pl.DataFrame | tuple[pl.DataFrame, ...] | StageResult


def stage(fn: Callable[..., Frames]) -> dg.AssetsDefinition:
    """Make assets of a function named like a stage declared in `pipelines.lineage`.

    The function's arguments are named after the tables it reads; `scope` and `home` give it the run's cells and
    folders, with which it may read a part of its parents. It returns one frame a table, in the order of the stage's
    tables. Each is checked against its declaration before it is stored: an invalid row goes to quarantine; where the
    table is valid only as a whole, nothing is stored and what depends on it does not run.

    Raises
    ------
    ValueError
        Where an argument is a table whose changes would not make the stage stale.
    """
    declaration = STAGE[fn.__name__]
    arguments = list(inspect.signature(fn).parameters)
    first_line = inspect.getdoc(fn) or ""
    condition = condition_of(declaration)

    @dg.multi_asset(
        name=declaration.name,
        outs={t: _out(t, declaration, first_line, condition) for t in declaration.tables},
        deps=[dg.AssetKey(t) for t in _upstream_tables(declaration, [p for p in arguments if p in TABLES])],
        partitions_def=_PARTITIONS[declaration.grain],
        check_specs=[
            dg.AssetCheckSpec(CHECK, asset=t, blocking=True, description=f"{t} {CHECK_MEANING}")
            for t in declaration.tables
        ],
        backfill_policy=dg.BackfillPolicy.single_run(),
        description=first_line,
        op_tags={"hdt/stage": declaration.group},
    )
    def run(context: dg.AssetExecutionContext, home: Home) -> Iterator[Any]:
        scope = PartitionScope.of(None if declaration.grain == "fleet" else list(context.partition_keys))
        resources: dict[str, Any] = {"scope": scope, "home": home}
        start = time.monotonic()
        versions = scope.versions(home.ledger, declaration)  # first: what is read is as new, and what comes is stale
        with panics_as_errors():
            outcome = fn(**{p: resources[p] if p in resources else scope.read_table(home.store, p) for p in arguments})
        duration = {"seconds": round(time.monotonic() - start, 3)}
        result = _as_stage_result(outcome)
        store = home.store
        ledger = home.ledger
        if result.inputs_changed:
            versions = scope.versions(ledger, declaration)
        set_aside = tables_set_aside(store, declaration.grain)
        metadata = result.metadata

        def quarantine(table: str, rows: pl.DataFrame) -> None:
            with storing(ledger, scope, table, versions[table], context.run.tags):
                store_broken_rows(store, ledger, scope, table, rows)

        for table, frame in zip(declaration.tables, result.frames, strict=True):
            checked = _check_and_store(
                table, frame, duration, metadata, partial(quarantine, table), has_old_rows=table in set_aside
            )
            for event in checked:
                yield _with_cells(event, versions[table]) if isinstance(event, dg.Output) else event
            metadata = {}

    return run


def _as_stage_result(outcome: Frames) -> StageResult:
    if isinstance(outcome, StageResult):
        return outcome
    return StageResult((outcome,) if isinstance(outcome, pl.DataFrame) else outcome, {})


def _with_cells(output: dg.Output[pl.DataFrame], cells: pl.DataFrame) -> dg.Output[Made]:
    return dg.Output(Made(output.value, cells), output_name=output.output_name, metadata=output.metadata)


def _upstream_tables(declaration: Stage, arguments: list[str]) -> list[str]:
    """Return upstream tables: those read as arguments, and parents read through the home."""
    untracked = set(arguments) - UPSTREAM[declaration.name]
    if untracked:
        raise ValueError(
            f"{declaration.name} reads {', '.join(sorted(untracked))}, of which its lineage follows no change"
        )
    makers = [MAKER[table].name for table in arguments]
    return [*arguments, *(parent for parent in declaration.parents if MAKER[parent].name not in makers)]


def _out(
    table: str, declaration: Stage, description: str, condition: dg.AutomationCondition[dg.AssetKey] | None
) -> dg.AssetOut:
    schema = TABLES[table].schema
    first = (inspect.getdoc(schema) or "").splitlines()[0]
    columns = [dg.TableColumn(n, str(c.dtype), description=MEANINGS[table][n]) for n, c in schema.columns().items()]
    return dg.AssetOut(
        **group_of(declaration.group),
        kinds={"deltalake", _TOOLS.get(declaration.group, "polars")},
        automation_condition=condition,
        description=f"{first}\n\n{description}",
        code_version=declaration.tables[table].code,
        freshness_policy=FRESHNESS if table == declaration.fresh else None,
        metadata={"dagster/column_schema": dg.TableSchema(columns=columns), "grain": TABLES[table].grain},
    )


def _check_and_store(
    table: str,
    frame: pl.DataFrame,
    duration: dict[str, float],
    metadata: Mapping[str, Any],
    quarantine: Callable[[pl.DataFrame], None],
    *,
    has_old_rows: bool = False,
) -> Iterator[Any]:
    """Check a table and yield result and valid rows; `quarantine` receives the invalid ones.

    It is called without rows too where it may have old ones of these cells to remove.

    The check reports on the run: rows, flights and the `duration`. The output is reported by partition, so only
    `metadata` goes with it.
    """
    frame = TABLES[table].conform(frame)
    valid, broken = TABLES[table].schema.split_valid(frame)
    faults = TABLES[table].schema.count_faults(broken, frame.height)
    is_refused = bool(faults) and (TABLES[table].whole or (TABLES[table].grain == "fleet" and not valid.height))
    findings = "; ".join(faults) or f"{frame.height} rows, each as declared"
    action = "not stored: " if is_refused else "set aside in quarantine: " if faults else ""
    yield CheckBeforeStorage(
        check_name=CHECK,
        asset_key=table,
        passed=not faults,
        severity=dg.AssetCheckSeverity.ERROR if is_refused else dg.AssetCheckSeverity.WARN,
        description=action + findings,
        metadata={"rows": frame.height, "faults": "; ".join(faults) or "none", **duration, **_numbers(valid)},
    )
    if is_refused:
        raise dg.Failure(f"{table} breaks its declaration, so it was not stored: {findings}")
    if broken.height or has_old_rows:
        quarantine(broken)
    yield dg.Output(valid, output_name=table, metadata=metadata)


def _numbers(frame: pl.DataFrame) -> dict[str, int]:
    labels = {"flight_id": "flights", "tail": "aircraft"}
    return {name: frame[c].n_unique() for c, name in labels.items() if c in frame.columns}


def any_parent_newer(parents: Iterable[str | dg.AssetKey]) -> dg.AutomationCondition[dg.AssetKey]:
    """Build the condition that a parent is newer than the asset, or requested, and none is in progress."""
    requested = dg.AutomationCondition.newly_requested() | dg.AutomationCondition.newly_updated()
    newer = dg.AutomationCondition.any_deps_updated().allow(dg.AssetSelection.assets(*parents)).since(requested)
    busy = dg.AutomationCondition.any_deps_in_progress() | dg.AutomationCondition.in_progress()
    return (newer & ~busy).with_label("made from something newer")


def condition_of(stage: Stage) -> dg.AutomationCondition[dg.AssetKey] | None:
    """Return a stage's condition; None if made from files, which `landing_zone` watches, or from a baseline alone."""
    follows = stage.parents and not any(recipe.baseline or recipe.files for recipe in stage.tables.values())
    return any_parent_newer(stage.parents) if follows else None


# Both are off by default. A night finds stale cells by hashes; Dagster compares times, so it makes never less and
# sometimes more. Published assets are made after a night's runs, so their sensor can run beside nights.
SENSORS = (
    dg.AutomationConditionSensorDefinition(
        "publish_what_is_newer",
        target=dg.AssetSelection.groups(PUBLISHED),
        description="Makes the catalog and the report where tables are newer.",
    ),
    dg.AutomationConditionSensorDefinition(
        "make_what_follows",
        target=dg.AssetSelection.all() - dg.AssetSelection.groups(PUBLISHED),
        description="Makes stages whose parents are newer, where no nights run and files are taken in by hand.",
    ),
)
