"""What a fleet teaches grows with its failures; without any the prior stands."""

import numpy as np
import pytest

from hdt_core.prognosis.hazard import EDGES, SPANS, event_by
from hdt_core.prognosis.limits import PRIORS, learn_limit
from hdt_core.prognosis.recalibrate import Correction, learn_correction, learn_levels


def lives(n: int, rate: float) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(2)
    death = rng.exponential(1.0 / rate, n)
    left = np.concatenate([np.arange(d, 0.0, -10.0) for d in death])
    life = np.concatenate([np.full(len(np.arange(d, 0.0, -10.0)), i) for i, d in enumerate(death)])
    return left, np.ones(left.size, bool), life


def test_no_failure_no_correction():
    hazard = np.full((30, SPANS), 0.1)
    done = learn_correction(hazard, np.zeros(30), np.full(30, 400.0), np.zeros(30, bool), np.arange(30))
    assert done == Correction()
    assert learn_levels(event_by(hazard)[:0], np.empty(0), np.empty(0, int), (0.04, 0.96)) == (0.04, 0.96)


@pytest.mark.parametrize(("n", "share"), [(3, 0.1), (200, 0.6)])
def test_a_hazard_twice_too_low_is_corrected_as_far_as_the_lives_carry(n, share):
    left, failed, life = lives(n, 0.02)
    hazard = np.broadcast_to(1.0 - np.exp(-0.01 * np.diff(EDGES)), (left.size, SPANS))
    done = learn_correction(hazard, np.full(left.size, 0.5), left, failed, life)
    before = event_by(hazard)[0, 7]
    after = event_by(done(hazard[:1], np.array([0.5])))[0, 7]
    truth = 1.0 - np.exp(-0.02 * 50.0)
    assert after > before
    assert (after - before) / (truth - before) > share
    assert after < truth + 0.1


def test_limit_moves_from_the_prior_to_the_messages():
    prior = PRIORS["HX"]
    assert learn_limit(np.empty(0), prior) == prior
    few, many = learn_limit(np.full(1, 0.3), prior), learn_limit(np.full(30, 0.3), prior)
    assert 0.3 < few.mean < prior.mean
    assert many.mean == pytest.approx(0.3, abs=0.01)
    assert many.sd < few.sd < prior.sd


def test_a_clog_does_not_pull_the_limit_far():
    levels = np.array([0.40, 0.41, 0.39, 0.40])
    clean, clogged = learn_limit(levels, PRIORS["HX"]), learn_limit(np.append(levels, 0.8), PRIORS["HX"])
    assert abs(clogged.mean - clean.mean) < 0.03
