"""The shipped base is the one that the present code learns."""

import os

import long_tests
import pytest

from pipelines import learned
from pipelines.learned import recipe


def test_present_sources_learn_shipped_base():
    """Sources that it was learned from, or found to learn the same, need not learn again; a soak does all the same."""
    if learned.shipped_recipe()["sources"] != recipe.sources() or "HDT_SOAK_KILLS" in os.environ:
        mean, far = recipe.differences()
        assert mean < recipe.MEAN
        assert far < recipe.FAR


def test_comments_are_no_source():
    assert recipe.code_of('"""One."""\nx = 1  # one\n') == recipe.code_of('"""Two."""\nx = 1\n')


def test_changed_code_changes_the_sources(monkeypatch):
    before = recipe.sources()
    code = recipe.code_of
    monkeypatch.setattr(
        recipe, "code_of", lambda text: code(text.replace("RATE, RATE_SD = 0.0012", "RATE, RATE_SD = 0.0013"))
    )
    assert recipe.sources() != before


def test_stale_base_is_refused(monkeypatch):
    monkeypatch.setattr(learned, "INPUTS", ("another",))
    with pytest.raises(learned.StaleBaseError, match=r"python -m pipelines\.learned"):
        learned.shipped_base()


def test_learning_group_follows_the_imports():
    (group,) = [g for g in long_tests.groups() if g.name == "learning"]

    places = {long_tests.ROOT / place for place in long_tests.places(group.sources)}

    assert set(recipe.source_files()) <= places
