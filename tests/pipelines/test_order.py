"""The order of runs follows from what the stages are made from."""

from itertools import permutations

import pytest

from pipelines.lineage import STAGE, STAGES, declare_stage, steps


def test_every_stage_is_made_once_and_after_what_it_needs():
    there: set[str] = set()
    for step in steps(STAGES):
        assert len({stage.grain for stage in step.stages}) == 1
        for stage in step.stages:
            assert there.issuperset((*stage.parents, *stage.untracked)), stage.name
            assert there.isdisjoint(stage.tables)
            there.update(stage.tables)
    assert there == {table for stage in STAGES for table in stage.tables}


def test_a_night_takes_seven_runs():
    """Fleet, aircraft and flights are taken in; the model; flights, aircraft and fleet are followed with it."""
    assert [s.grain for s in steps(STAGES)] == ["fleet", "aircraft", "flight", "fleet", "flight", "aircraft", "fleet"]


HEALTH = {"twin_health", "legs_admitted", "features", "features_alerts"}


@pytest.mark.parametrize(
    ("stale", "made"),
    [
        ("raw_components", {"raw_components", "calibration_components", *HEALTH}),
        ("twin_health", HEALTH),
        ("features_alerts", {"features_alerts"}),
    ],
)
def test_of_a_run_only_stages_are_made_that_follow_from_a_stale_one(stale, made):
    (step,) = [step for step in steps(STAGES) if STAGE[stale] in step.stages]
    assert step.tables([stale]) == [t for stage in step.stages if stage.name in made for t in stage.tables]
    assert step.tables([]) == []


def test_every_run_has_a_name():
    assert all(any(stage.label for stage in step.stages) for step in steps(STAGES))


CHAIN = (
    declare_stage("one", "any", "raw_flights"),
    declare_stage("two", "any", "legs_samples", parents=("raw_flights",)),
    declare_stage("three", "any", "twin_health", parents=("legs_samples",)),
    declare_stage("four", "any", "calibration_dsm", untracked=("twin_health",)),
)


@pytest.mark.parametrize("declared", list(permutations(CHAIN)), ids=lambda stages: "-".join(s.name for s in stages))
def test_it_does_not_matter_in_which_order_a_chain_is_declared(declared):
    assert [[s.name for s in step.stages] for step in steps(declared)] == [["one", "two"], ["three"], ["four"]]


def test_a_circle_is_named():
    circle = declare_stage("legs", "any", "legs_samples", parents=("residuals",))
    with pytest.raises(ValueError, match="form a cycle: legs, residuals"):
        steps([circle, declare_stage("residuals", "any", "residuals", parents=("legs_samples",))])
