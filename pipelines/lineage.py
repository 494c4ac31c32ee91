"""Declare every stage of the chain once: its tables, their parents and the version of the code.

The order of runs (`pipelines.orchestration.order`), what is stale (`pipelines.versions`) and Dagster's graph
(`pipelines.assets`) follow from these declarations. The functions are in `pipelines/assets/`, each named like its
stage. Nothing here needs Dagster, so a night with nothing new stays quick.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from hdt_core.components import components
from hdt_core.tables import TABLES

Grain = Literal["flight", "aircraft", "fleet"]
BATCH_FACTORS = {"flight": 4, "aircraft": 20, "fleet": 1}
FLIGHT_FILES = ("acms", "history", "cpl", "recorder")
RECORD_FILES = ("messages", "maintenance", "reports")
DECLARED = "1 " + " ".join(c.version for c in components().values())
"""Version of the declared components: a change of one makes its results again."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Inputs of a table; its cells' versions are hashes of them, so an edit here makes them again.

    Parameters
    ----------
    parents : tuple of str
        Tables whose versions count, in this order.
    files : tuple of str
        Kinds of delivered file whose contents count.
    baseline : bool
        Only the commissioning window of the parents counts.
    settings : tuple of str
        Settings of the home that count: accepted physical terms, alert limits (`settings.HOME_SETTINGS`).
    code : str
        Version of the code; raise it when what is computed changes.
    """

    parents: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    baseline: bool = False
    settings: tuple[str, ...] = ()
    code: str = "1"


@dataclass(frozen=True)
class Stage:
    """Tables that one function makes together.

    Parameters
    ----------
    name : str
        Name of the function.
    group : str
        Group in Dagster's graph.
    tables : mapping of str to Recipe
        Tables in the order in which they are returned and stored.
    untracked : tuple of str
        Tables that are read but not tracked: a change of them makes nothing stale.
    fresh : str
        Table that every flight updates, whose freshness is checked.
    label : str
        Name of the run that begins with this stage.
    batch_factor : int, optional
        Flights that a run may take, as a multiple of those of a run that reads files; by grain where not given. Fewer
        runs cost less bookkeeping.
    """

    name: str
    group: str
    tables: Mapping[str, Recipe]
    untracked: tuple[str, ...] = ()
    fresh: str = ""
    label: str = ""
    batch_factor: int | None = None

    @cached_property
    def grain(self) -> Grain:
        """Partition of all its tables."""
        (grain,) = {TABLES[table].grain for table in self.tables}
        return grain

    @cached_property
    def parents(self) -> tuple[str, ...]:
        """Tables whose versions count in its own, in order."""
        return tuple(dict.fromkeys(parent for recipe in self.tables.values() for parent in recipe.parents))

    @cached_property
    def size(self) -> int:
        """Flights that a run may take, as a multiple of those of a run that reads files."""
        return BATCH_FACTORS[self.grain] if self.batch_factor is None else self.batch_factor


def upstream_tables(stage: Stage) -> set[str]:
    """Collect tables a change of which makes the stage stale: its parents, their siblings and their own parents.

    Parents of a baseline are not among them, for it depends on them within its window only.
    """
    tables, pending = set[str](), list(stage.parents)
    while pending:
        table = pending.pop()
        if table not in tables:
            recipe = LINEAGE[table]
            tables |= {t for t, r in MAKER[table].tables.items() if r == recipe}
            pending += () if recipe.baseline else recipe.parents
    return tables


def same_recipe(*tables: str, **recipe: object) -> dict[str, Recipe]:
    """Declare tables with the same recipe."""
    return dict.fromkeys(tables, Recipe(**recipe))  # type: ignore[arg-type]


STAGES = (
    Stage(
        "raw_fleet",
        "raw",
        {
            **same_recipe(
                "raw_fleet",
                "raw_files_deliveries",
                "raw_files_quarantine",
                files=("fleet", "rejected", "refused", "checks", "costs"),
            ),
            "raw_coverage": Recipe(files=("fleet", "type"), code=DECLARED),
            "raw_checks": Recipe(files=("checks",)),
            "raw_costs": Recipe(files=("costs",), code=DECLARED),
        },
        label="fleet list and refused files",
    ),
    Stage(
        "raw_records",
        "raw",
        {
            "raw_messages": Recipe(files=("messages",), code="3"),
            "raw_maintenance": Recipe(files=("maintenance", "findings"), code="5"),
            "raw_cases": Recipe(files=("cases",)),
            "raw_reports": Recipe(files=("reports",)),
            **same_recipe("raw_records_deliveries", "raw_records_quarantine", files=RECORD_FILES, code="3"),
        },
        untracked=("raw_fleet",),
        label="messages and maintenance",
    ),
    Stage(
        "raw",
        "raw",
        same_recipe(
            "raw_snapshots", "raw_logs", "raw_deliveries", "raw_quarantine", "raw_flights", files=FLIGHT_FILES, code="3"
        ),
        untracked=("raw_fleet",),
        fresh="raw_flights",
        label="flights and legs",
        batch_factor=1,
    ),
    Stage(
        "legs",
        "legs",
        same_recipe("legs_samples", "legs_verdicts", parents=("raw_flights",), code="3"),
        fresh="legs_verdicts",
    ),
    Stage(
        "calibration",
        "calibration",
        same_recipe(
            "calibration_dsm",
            "calibration_design",
            "calibration_schedules",
            "calibration_window",
            parents=("legs_samples", "legs_verdicts", "raw_maintenance", "raw_messages", "raw_reports"),
            baseline=True,
            code="15",
        ),
        label="digital system model",
    ),
    Stage(
        "twin_flights",
        "twin",
        same_recipe("twin_flights", parents=("legs_samples", "calibration_dsm"), code="5"),
        fresh="twin_flights",
        label="operational twins",
    ),
    Stage(
        "residuals",
        "residuals",
        same_recipe("residuals", parents=("twin_flights",), code="3"),
        fresh="residuals",
    ),
    Stage(
        "indicators",
        "features",
        same_recipe("legs_indicators", "features_cross_checks", parents=("legs_samples", "calibration_schedules")),
    ),
    Stage(
        "features_margin",
        "features",
        same_recipe("features_margin", parents=("legs_samples", "calibration_dsm", "calibration_schedules"), code="3"),
    ),
    Stage(
        "twin_health",
        "twin",
        same_recipe("twin_health", "twin_checkpoints", parents=("twin_flights", "raw_maintenance"), code="13"),
        fresh="twin_health",
        label="health, features, alerts",
    ),
    Stage(
        "legs_admitted",
        "features",  # legs are admitted after the twin, which does not depend on it
        same_recipe(
            "legs_admitted",
            parents=(
                "twin_health",
                "twin_flights",
                "legs_indicators",
                "raw_messages",
                "raw_maintenance",
                "raw_reports",
            ),
            code="5",
        ),
    ),
    Stage(
        "features",
        "features",
        same_recipe(
            "features",
            parents=("twin_health", "residuals", "features_cross_checks", "features_margin", "raw_maintenance"),
            code="8",
        ),
        fresh="features",
    ),
    Stage(
        "features_alerts",
        "features",
        same_recipe("features_alerts", parents=("features",), settings=("limits",), code="18"),
    ),
    Stage(
        "raw_components",
        "raw",
        same_recipe(
            "raw_components",
            "raw_components_deliveries",
            "raw_components_quarantine",
            files=("component", "recorder"),
            code=f"2 {DECLARED}",
        ),
        untracked=("raw_fleet",),
    ),
    Stage(
        "calibration_components",
        "calibration",
        same_recipe(
            "legs_components",
            "calibration_components",
            parents=("raw_components", "raw_maintenance", "raw_reports"),
            settings=("terms",),
            code=f"3 {DECLARED}",
        ),
    ),
    Stage(
        "twin_components",
        "twin",
        same_recipe("twin_components", "residuals_components", parents=("calibration_components",), code="4"),
    ),
    Stage(
        "features_components",
        "features",
        same_recipe(
            "features_components",
            "features_component_alerts",
            parents=("twin_components",),
            settings=("limits",),
            code="6",
        ),
    ),
    Stage("declared_components", "raw", same_recipe("components", code=DECLARED)),
    Stage("prognosis_base", "prognosis", same_recipe("prognosis_base", code="4"), label="prognosis"),
    # a model is stored with its scored flights, so prognoses come first: a kill between them costs only work
    Stage(
        "prognosis",
        "prognosis",
        same_recipe(
            "prognoses",
            "prognosis_model",
            "prognosis_lives",
            parents=("features", "features_margin", "prognosis_base", "raw_messages", "raw_maintenance"),
            code="9",
        ),
        fresh="prognoses",
    ),
    Stage(
        "prognoses_components",
        "prognosis",
        same_recipe(
            "prognoses_components",
            "prognoses_components_lives",
            parents=("features_components", "raw_messages", "raw_maintenance"),
            code="2",
        ),
    ),
)

STAGE = {stage.name: stage for stage in STAGES}
MAKER = {table: stage for stage in STAGES for table in stage.tables}
LINEAGE = {table: recipe for stage in STAGES for table, recipe in stage.tables.items()}
UPSTREAM = {stage.name: upstream_tables(stage) for stage in STAGES}
