"""What Dagster's daemon may make by itself: what follows from other assets, and nothing that follows from files.

Both sensors are off until someone turns them on. A night knows by hashes what is stale (`pipelines.versions`); Dagster
knows when something was made, so what it would make is never less and sometimes more. Who lets it make stages runs no
nights beside it. What is published is made after a night's runs, so its sensor goes with nights.
"""

from collections.abc import Iterable

import dagster as dg

from pipelines.lineage import Stage

PUBLISHED = "published"
"""Group of what readers meet."""


def newer_than_made(parents: Iterable[str | dg.AssetKey]) -> dg.AutomationCondition[dg.AssetKey]:
    """A parent was made, or is about to be, since the asset was; and none of them is being made."""
    asked = dg.AutomationCondition.newly_requested() | dg.AutomationCondition.newly_updated()
    newer = dg.AutomationCondition.any_deps_updated().allow(dg.AssetSelection.assets(*parents)).since(asked)
    busy = dg.AutomationCondition.any_deps_in_progress() | dg.AutomationCondition.in_progress()
    return (newer & ~busy).with_label("made from something newer")


def condition_of(stage: Stage) -> dg.AutomationCondition[dg.AssetKey] | None:
    """None of a stage that is made from files, for which the sensor `landing_zone` looks, or from a baseline alone."""
    follows = stage.parents and not any(recipe.baseline or recipe.files for recipe in stage.tables.values())
    return newer_than_made(stage.parents) if follows else None


SENSORS = (
    dg.AutomationConditionSensorDefinition(
        "publish_what_is_newer",
        target=dg.AssetSelection.groups(PUBLISHED),
        description="The catalog and the report, where tables are newer: a report after every night.",
    ),
    dg.AutomationConditionSensorDefinition(
        "make_what_follows",
        target=dg.AssetSelection.all() - dg.AssetSelection.groups(PUBLISHED),
        description="Stages whose parents are newer, for who runs no nights: files are taken in by hand.",
    ),
)
