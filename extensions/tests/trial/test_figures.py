"""The page's numbers hold the truth of simulated trials, and what is too few does not leave."""

import doctest
import math
from collections import Counter

import pytest
import trials

from hdt_trial import figures, intervals
from hdt_trial.evaluation import evaluated
from hdt_trial.page import page

TRIALS = 50


@pytest.fixture(scope="module")
def declared():
    return trials.declaration()


def evaluation(seed, tails, declared):
    units = trials.fleet(seed, tails)
    return evaluated(trials.log(units), declared, trials.outcomes(units, declared), {})


def test_every_figure_holds_the_truth_in_88_percent_of_50_trials(declared):
    """Truth: the generator's own account of 800 aircraft, lives whole. Trials: 30 aircraft, 300 sealed flights."""
    truth = trials.truth(trials.fleet(10**6, 800), declared)
    held, told = Counter(), Counter()
    for seed in range(TRIALS):
        for f in evaluation(seed, 30, declared).figures["hdt"]:
            assert f.told is not None, f
            low, high = (v if v is not None else s * math.inf for v, s in ((f.told.low, -1), (f.told.high, 1)))
            held[f.name] += low <= truth[f.name] <= high
            told[f.name] += 1
    assert set(told) == set(truth)
    assert {name: n for name, n in held.items() if n < 0.88 * TRIALS} == {}


def test_a_small_fleet_gives_nothing_away(declared):
    told = evaluation(5, 3, declared)
    assert {f.told for f in told.figures["hdt"]} == {None}
    assert all(n is None or n == 0 or n >= declared.minimum.count for n in told.verdicts["hdt"].values())


def test_the_page_names_no_aircraft_and_says_what_n_is(declared):
    told = evaluation(5, 30, declared)
    html = page(told)
    assert "T-0" not in html
    assert "AAA" not in html
    assert "per 1,000 flights" in html
    assert "events</td>" in html
    assert told.after_the_fact == 0
    assert "rehearsal" not in html


@pytest.mark.parametrize("module", [figures, intervals])
def test_examples(module):
    assert doctest.testmod(module).failed == 0
