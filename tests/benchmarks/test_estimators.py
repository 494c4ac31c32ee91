"""The exchanger's benchmark: every contestant does the same work."""

import pytest

pytest.importorskip("numba")

from benchmarks.estimators import conductance_claim, effectiveness_claim


# the ratios depend on the machine and are the benchmark's to print
@pytest.mark.parametrize("claim", [conductance_claim, effectiveness_claim])
def test_peers_give_same_answers(claim):
    assert max(claim(rounds=1).apart.values()) < 1e-6
