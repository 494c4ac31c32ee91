"""Every stage of the chain, declared once: what it makes, from what, by which version of the code.

The order of runs (`pipelines.orchestration.order`), what is stale (`pipelines.versions`) and Dagster's graph
(`pipelines.assets`) follow from these declarations. The functions stand in `pipelines/assets/`, each under its stage's
name. Nothing here needs Dagster, so a night with nothing new stays quick.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from hdt_core.components import components
from hdt_core.tables import TABLES

Grain = Literal["flight", "aircraft", "fleet"]
FOLDED = {"flight": 4, "aircraft": 20, "fleet": 1}
PACK, COMPONENT = "pack", "component"
FLIGHT_FILES = ("acms", "history", "cpl", "recorder")
RECORD_FILES = ("messages", "maintenance", "reports")
DECLARED = "1 " + " ".join(c.version for c in components().values())
"""Of what follows from the components that are declared: a change of one makes its results again."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """What a table is made from; its cells' versions are hashes of it, so an edit here makes them again.

    Parameters
    ----------
    parents : tuple of str
        Tables whose versions count, in this order.
    files : tuple of str
        Kinds of delivered file whose contents count.
    baseline : bool
        Only the commissioning window of the parents counts.
    settings : tuple of str
        What the home sets that counts: accepted physical terms, alert limits (`settings.HOME_SETTINGS`).
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
        Group it is drawn in.
    tables : mapping of str to Recipe
        Tables in the order in which they are returned and stored.
    untracked : tuple of str
        Tables that are read as they are: made before, but a change of them makes nothing stale.
    fresh : str
        The table that every flight moves: no news of it is news.
    label : str
        What the run is called that begins with this stage.
    folded : int, optional
        How many times as many flights a run may take as one that reads files; by grain where it is not given. The
        fewer runs, the less is bookkeeping.
    road : str
        `pack`, or `component` for what few aircraft have: a run goes along one of them.
    """

    name: str
    group: str
    tables: Mapping[str, Recipe]
    untracked: tuple[str, ...] = ()
    fresh: str = ""
    label: str = ""
    folded: int | None = None
    road: str = PACK

    @cached_property
    def grain(self) -> Grain:
        """Partition that all its tables are computed in."""
        (grain,) = {TABLES[table].grain for table in self.tables}
        return grain

    @cached_property
    def parents(self) -> tuple[str, ...]:
        """Tables whose versions count in its own, in order."""
        return tuple(dict.fromkeys(parent for recipe in self.tables.values() for parent in recipe.parents))

    @cached_property
    def size(self) -> int:
        """How many times as many flights a run may take as one that reads files."""
        return FOLDED[self.grain] if self.folded is None else self.folded


def followed(stage: Stage) -> set[str]:
    """Tables a change of which makes the stage stale: its parents, what is made with them and what they follow.

    What a baseline follows is not among them, for it follows that within its window only.
    """
    found, left = set[str](), list(stage.parents)
    while left:
        table = left.pop()
        if table not in found:
            recipe = LINEAGE[table]
            found |= {t for t, r in MAKER[table].tables.items() if r == recipe}
            left += () if recipe.baseline else recipe.parents
    return found


def alike(*tables: str, **recipe: object) -> dict[str, Recipe]:
    """Tables made by one recipe."""
    return dict.fromkeys(tables, Recipe(**recipe))  # type: ignore[arg-type]


STAGES = (
    Stage(
        "raw_fleet",
        "raw",
        {
            **alike(
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
            **alike("raw_records_deliveries", "raw_records_quarantine", files=RECORD_FILES, code="3"),
        },
        untracked=("raw_fleet",),
        label="messages and maintenance",
    ),
    Stage(
        "raw",
        "raw",
        alike(
            "raw_snapshots", "raw_logs", "raw_deliveries", "raw_quarantine", "raw_flights", files=FLIGHT_FILES, code="3"
        ),
        untracked=("raw_fleet",),
        fresh="raw_flights",
        label="flights and legs",
        folded=1,
    ),
    Stage(
        "legs",
        "legs",
        alike("legs_samples", "legs_verdicts", parents=("raw_flights",), code="3"),
        fresh="legs_verdicts",
    ),
    Stage(
        "calibration",
        "calibration",
        alike(
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
        alike("twin_flights", parents=("legs_samples", "calibration_dsm"), code="5"),
        fresh="twin_flights",
        label="operational twins",
    ),
    Stage(
        "residuals",
        "residuals",
        alike("residuals", parents=("twin_flights",), code="3"),
        fresh="residuals",
    ),
    Stage(
        "indicators",
        "features",
        alike("legs_indicators", "features_cross_checks", parents=("legs_samples", "calibration_schedules")),
    ),
    Stage(
        "features_margin",
        "features",
        alike("features_margin", parents=("legs_samples", "calibration_dsm", "calibration_schedules"), code="3"),
    ),
    Stage(
        "twin_health",
        "twin",
        alike("twin_health", "twin_checkpoints", parents=("twin_flights", "raw_maintenance"), code="13"),
        fresh="twin_health",
        label="health, features, alerts",
    ),
    Stage(
        "legs_admitted",
        "features",  # what the twin decides about legs comes after it: no arrow leads back
        alike(
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
        alike(
            "features",
            parents=("twin_health", "residuals", "features_cross_checks", "features_margin", "raw_maintenance"),
            code="8",
        ),
        fresh="features",
    ),
    Stage(
        "features_alerts",
        "features",
        alike("features_alerts", parents=("features",), settings=("limits",), code="17"),
    ),
    Stage(
        "raw_components",
        "raw",
        alike(
            "raw_components",
            "raw_components_deliveries",
            "raw_components_quarantine",
            files=("component", "recorder"),
            code=f"2 {DECLARED}",
        ),
        untracked=("raw_fleet",),
        label="declared components",
        road=COMPONENT,
    ),
    Stage(
        "calibration_components",
        "calibration",
        alike(
            "legs_components",
            "calibration_components",
            parents=("raw_components", "raw_maintenance", "raw_reports"),
            settings=("terms",),
            code=f"3 {DECLARED}",
        ),
        road=COMPONENT,
    ),
    Stage(
        "twin_components",
        "twin",
        alike("twin_components", "residuals_components", parents=("calibration_components",), code="3"),
        road=COMPONENT,
    ),
    Stage(
        "features_components",
        "features",
        alike("features_components", "features_component_alerts", parents=("twin_components",), code="4"),
        road=COMPONENT,
    ),
    Stage("declared_components", "raw", alike("components", code=DECLARED)),
    Stage("prognosis_base", "prognosis", alike("prognosis_base", code="4"), label="prognosis"),
    # what a model has spoken about is stored with it, so prognoses come first: a kill between them costs only work
    Stage(
        "prognosis",
        "prognosis",
        alike(
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
        alike(
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
FOLLOWED = {stage.name: followed(stage) for stage in STAGES}
