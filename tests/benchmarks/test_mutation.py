"""Mutants change one place that means something; a room's tests are asked about each in a copy of the tree."""

import tomllib

from cosmic_ray.mutating import mutate_code

from benchmarks.mutation import ROOT, edit, places

SOURCE = '''"""Text 1."""
LIMIT, STEP = 4.0, 3


def beyond(*, x: float | None = -2.0) -> bool | None:
    """Text > 2."""
    if x is None:
        raise ValueError(f"{x + 1} is none")
    return x > LIMIT
'''


def test_mutants_change_no_words():
    after = {edit(SOURCE, mutate_code(SOURCE, *place))[1] for place in places(SOURCE)}
    assert after == {
        "LIMIT, STEP = 3.4, 3", "LIMIT, STEP = 4.6, 3", "LIMIT, STEP = 4.0, 2", "LIMIT, STEP = 4.0, 4",
        "def beyond(*, x: float | None = - 1.7) -> bool | None:",
        "def beyond(*, x: float | None = - 2.3) -> bool | None:",
        "def beyond(*, x: float | None = 2.0) -> bool | None:", "if not x is None:", "if x is not None:",
        "return x < LIMIT", "return x >= LIMIT",
    }  # fmt: skip


EQUIVALENT = tomllib.loads((ROOT / "tests/mutants.toml").read_text())["equivalent"]


def test_equivalent_mutants_edit_present_lines():
    assert [e for e in EQUIVALENT if e["before"] not in (ROOT / e["module"]).read_text()] == []


def test_equivalent_mutants_are_listed_once():
    keys = [(e["module"], e["before"], *e["after"]) for e in EQUIVALENT]
    assert len(set(keys)) == len(keys)
