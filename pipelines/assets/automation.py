"""Conditions by which Dagster's daemon may make assets that follow from other assets, never those made from files.

Both sensors are off by default. A night finds stale cells by hashes (`pipelines.versions`); Dagster compares times, so
it makes never less and sometimes more. Let it make stages only where no nights run. Published assets are made after a
night's runs, so their sensor can run beside nights.
"""

from collections.abc import Iterable

import dagster as dg

from pipelines.lineage import Stage

PUBLISHED = "8_catalog_report"
"""Asset group of the catalog and the report."""


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
