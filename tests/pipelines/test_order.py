"""The order of runs follows from what the stages are made from."""

from itertools import permutations

import pytest

from pipelines.lineage import COMPONENT, PACK, STAGES, Stage, same_recipe
from pipelines.orchestration.order import steps


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
    packs = [step for step in steps(STAGES) if step.stages[0].road == PACK]
    assert [s.grain for s in packs] == ["fleet", "aircraft", "flight", "fleet", "flight", "aircraft", "fleet"]


def test_declared_components_take_one_run_of_their_own():
    (own,) = [step for step in steps(STAGES) if step.stages[0].road == COMPONENT]
    assert own.grain == "aircraft"
    assert {stage.group for stage in own.stages} == {"raw", "calibration", "twin", "features"}


def test_every_run_has_a_name():
    assert all(any(stage.label for stage in step.stages) for step in steps(STAGES))


CHAIN = (
    Stage("one", "any", same_recipe("raw_flights")),
    Stage("two", "any", same_recipe("legs_samples", parents=("raw_flights",))),
    Stage("three", "any", same_recipe("twin_health", parents=("legs_samples",))),
    Stage("four", "any", same_recipe("calibration_dsm"), untracked=("twin_health",)),
)


@pytest.mark.parametrize("declared", list(permutations(CHAIN)), ids=lambda stages: "-".join(s.name for s in stages))
def test_it_does_not_matter_in_which_order_a_chain_is_declared(declared):
    assert [[s.name for s in step.stages] for step in steps(declared)] == [["one", "two"], ["three"], ["four"]]


def test_a_circle_is_named():
    circle = Stage("legs", "any", same_recipe("legs_samples", parents=("residuals",)))
    with pytest.raises(ValueError, match="form a cycle: legs, residuals"):
        steps([circle, Stage("residuals", "any", same_recipe("residuals", parents=("legs_samples",)))])
