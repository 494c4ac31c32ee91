"""Declare every stage of the chain once: its tables, their parents and the version of the code.

The order of runs (`pipelines.lineage`), what is stale (`pipelines.versions`) and Dagster's graph
(`pipelines.assets`) follow from these declarations. The functions are in `pipelines/assets/`, each named like its
stage. Nothing here needs Dagster, so a night with nothing new stays quick.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

from hdt_core.components import components
from hdt_core.tables import TABLES

Grain = Literal["flight", "aircraft", "fleet"]
BATCH_FACTORS = {"flight": 4, "aircraft": 20, "fleet": 1}
FLIGHT_FILES = ("acms", "history", "cpl", "recorder")
HELD = "record_held"
"""Table of the flights that are held."""
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
    n_cell_parents : int
        An aircraft or flight with a cell in one of so many first parents has one here.
    files : tuple of str
        Kinds of delivered file whose contents count.
    baseline : bool
        Only the commissioning window of the parents counts.
    sisters : bool
        Only the level of each pack's first flights in the parents counts, whatever else made them again.
    judged : bool
        Only which flights of the parents are held counts, and each cell of a child depends on its own flights alone.
    settings : tuple of str
        Settings of the home that count: accepted physical terms, alert limits, estimators (`settings.HOME_SETTINGS`).
    code : str
        Version of the code; raise it when what is computed changes.
    """

    parents: tuple[str, ...] = ()
    n_cell_parents: int = 1
    files: tuple[str, ...] = ()
    baseline: bool = False
    sisters: bool = False
    judged: bool = False
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
    tables = set[str]()
    pending = list(stage.parents)
    while pending:
        table = pending.pop()
        if table not in tables:
            recipe = LINEAGE[table]
            tables |= {t for t, r in MAKER[table].tables.items() if r == recipe}
            pending += () if recipe.baseline else recipe.parents
    return tables


def declare_stage(
    name: str, group: str, *tables: str, label: str = "", fresh: str = "", untracked: tuple[str, ...] = (),
    batch_factor: int | None = None, **recipe: object,
) -> Stage:  # fmt: skip
    """Declare a stage whose tables have the same recipe: its parameters, and those of `Recipe`."""
    of_tables = dict.fromkeys(tables, Recipe(**recipe))  # type: ignore[arg-type]
    return Stage(name, group, of_tables, untracked, fresh, label, batch_factor)


_PROGNOSED = ("features", "features_margin", "prognosis_base", "raw_messages", "raw_maintenance")

STAGES = (
    Stage("raw_fleet", "raw", {
        **dict.fromkeys(
            ("raw_fleet", "raw_files_deliveries", "raw_files_quarantine"),
            Recipe(files=("fleet", "rejected", "refused", "checks", "costs"), code="4"),
        ),
        "raw_coverage": Recipe(files=("fleet", "type"), code=DECLARED),
        "raw_checks": Recipe(files=("checks",), code="2"),
        "raw_costs": Recipe(files=("costs",), code=DECLARED),
    }, label="fleet list and refused files"),
    Stage("raw_records", "raw", {
        "raw_messages": Recipe(files=("messages",), code="4"),
        **dict.fromkeys(
            ("raw_maintenance", "raw_maintenance_not_done"), Recipe(files=("maintenance", "findings"), code="9")
        ),
        "raw_reports": Recipe(files=("reports",)),
        **dict.fromkeys(("raw_records_deliveries", "raw_records_quarantine"), Recipe(files=RECORD_FILES, code="7")),
    }, untracked=("raw_fleet",), label="messages and maintenance"),
    declare_stage(
        "raw", "raw", "raw_snapshots", "raw_logs", "raw_deliveries", "raw_quarantine", "raw_flights",
        files=FLIGHT_FILES, code="7", untracked=("raw_fleet",), fresh="raw_flights", label="flights",
        batch_factor=1,
    ),
    declare_stage(
        "record", "record", HELD, parents=("raw_flights",), judged=True, code="4", label="judgement of the record",
    ),
    declare_stage(
        "legs", "legs", "legs_samples", "legs_verdicts", "legs_channels", parents=("raw_flights", HELD), code="7",
        fresh="legs_verdicts", label="legs",
    ),
    declare_stage(
        "calibration", "calibration",
        "calibration_dsm", "calibration_design", "calibration_schedules", "calibration_window",
        parents=("legs_samples", "legs_verdicts", "raw_maintenance", "raw_messages", "raw_reports"), baseline=True,
        settings=("design of packs",), code="20", label="digital system model",
    ),
    declare_stage(
        "twin_flights", "twin", "twin_flights", parents=("legs_samples", "calibration_dsm"),
        settings=("health of packs",), code="6", fresh="twin_flights", label="operational twins",
    ),
    declare_stage("residuals", "residuals", "residuals", parents=("twin_flights",), code="3", fresh="residuals"),
    declare_stage(
        "indicators", "features", "legs_indicators", "features_cross_checks",
        parents=("legs_samples", "calibration_schedules"), code="2",
    ),
    declare_stage(
        "features_margin", "features", "features_margin",
        parents=("legs_samples", "calibration_dsm", "calibration_schedules"), code="3",
    ),
    declare_stage(
        "raw_components", "raw", "raw_components", "raw_components_deliveries", "raw_components_quarantine",
        files=("component", "recorder"), code=f"3 {DECLARED}", untracked=("raw_fleet",),
        label="declared components",
    ),
    declare_stage(
        "calibration_components", "calibration", "legs_components", "calibration_components",
        parents=("raw_components", "raw_maintenance", "raw_reports", HELD),
        settings=("terms", "design of components"), code=f"5 {DECLARED}",
    ),
    declare_stage(
        "calibration_sisters", "calibration", "calibration_sisters", parents=("calibration_components",), sisters=True,
        code=f"1 {DECLARED}", label="sister units",
    ),
    declare_stage(
        "twin_health", "twin", "twin_health", "twin_checkpoints", "residuals_components",
        parents=("twin_flights", "calibration_components", "raw_maintenance", "calibration_sisters"), n_cell_parents=2,
        settings=("health of components",), code="22",
        fresh="twin_health", label="health, features, alerts",
    ),
    declare_stage(  # legs are admitted after the twin, which does not depend on it
        "legs_admitted", "features", "legs_admitted",
        parents=(
            "twin_flights", "twin_health", "legs_indicators", "raw_messages", "raw_maintenance", "raw_reports"
        ), code="6",
    ),
    declare_stage(
        "features", "features", "features", "features_components", "features_work",
        parents=(
            "twin_health", "residuals", "features_cross_checks", "features_margin", "raw_maintenance", "raw_messages"
        ), code="13", fresh="features",
    ),
    declare_stage(
        "features_alerts", "features", "features_alerts", parents=("features",), settings=("limits",), code="28",
    ),
    declare_stage(  # after the alerts, whose stage notes in the log which case goes on with which of them
        "raw_cases", "features", "raw_cases", parents=("features_alerts",), files=("cases",), code="2",
    ),
    declare_stage("declared_components", "raw", "components", code=f"2 {DECLARED}"),
    declare_stage("prognosis_base", "prognosis", "prognosis_base", code="4", label="prognosis"),
    # a model is stored with its scored flights, so prognoses come first: a kill between costs only work
    Stage("prognosis", "prognosis", {
        **dict.fromkeys(("prognoses", "prognosis_model", "prognosis_lives"), Recipe(parents=_PROGNOSED, code="16")),
        "prognosis_choices": Recipe(parents=_PROGNOSED, code="2"),
    }, fresh="prognoses"),
)  # fmt: skip

STAGE = {stage.name: stage for stage in STAGES}
MAKER = {table: stage for stage in STAGES for table in stage.tables}
LINEAGE = {table: recipe for stage in STAGES for table, recipe in stage.tables.items()}
UPSTREAM = {stage.name: upstream_tables(stage) for stage in STAGES}


class Step(NamedTuple):
    """Stages of one run: one grain, parents before children."""

    stages: tuple[Stage, ...]

    @property
    def grain(self) -> str:
        """Partition of the run."""
        return self.stages[0].grain

    @property
    def label(self) -> str:
        """Name of the run."""
        return next((stage.label for stage in self.stages if stage.label), self.stages[0].name)

    @property
    def batch_factor(self) -> int:
        """Flights that the run may take, as a multiple of those of a run that reads files."""
        return min(stage.size for stage in self.stages)

    def tables(self, stale: Collection[str]) -> list[str]:
        """List the tables of the `stale` stages, by name, and of those that follow from them."""
        tables = list[str]()
        for stage in self.stages:
            if stage.name in stale or not UPSTREAM[stage.name].isdisjoint(tables):
                tables += stage.tables
        return tables


def steps(stages: Iterable[Stage]) -> list[Step]:
    """Group stages into few runs in which every stage comes after its parents.

    From the end backwards: among the stages without remaining children, pick the last declared, with all of its grain,
    so that each stage runs as late as it can.

    Raises
    ------
    ValueError
        Where the stages' parents form a cycle.
    """
    remaining = list(stages)
    ordered_steps = list[Step]()
    while remaining:
        last = list[Stage]()
        while leaves := [s for s in _leaf_stages(remaining) if not last or s.grain == last[0].grain]:
            remaining.remove(leaves[-1])
            last.insert(0, leaves[-1])
        if not last:
            raise ValueError(f"stages form a cycle: {', '.join(s.name for s in remaining)}")
        ordered_steps.insert(0, Step(tuple(last)))
    return ordered_steps


def _leaf_stages(stages: Sequence[Stage]) -> list[Stage]:
    """Return stages whose tables no other stage reads."""
    parents = {table for stage in stages for table in (*stage.parents, *stage.untracked)}
    return [stage for stage in stages if not parents & set(stage.tables)]
