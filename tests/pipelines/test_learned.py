"""The shipped base is the one that the present code learns."""

import numpy as np
import pytest

from hdt_core.prognosis.hazard import event_by, hazards
from hdt_core.prognosis.model import fit_member
from hdt_core.prognosis.rows import simulated_rows
from pipelines import learned


def test_a_third_of_the_base_learned_again_says_the_same():
    """Trees may turn at another cut on another machine; what they say may not."""
    rows = simulated_rows(991, fleets=3)
    shipped, again = (event_by(hazards([m], rows.features)) for m in (learned.shipped_base().hazard[0], fit_member(0)))
    assert np.abs(shipped - again).mean() < 0.002
    assert np.quantile(np.abs(shipped - again), 0.99) < 0.03


def test_a_base_learned_from_other_inputs_is_refused(monkeypatch):
    monkeypatch.setattr(learned, "INPUTS", ("another",))
    with pytest.raises(learned.StaleBaseError, match=r"python -m pipelines\.learned"):
        learned.shipped_base.__wrapped__()
