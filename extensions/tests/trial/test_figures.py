"""The page's numbers hold the truth of simulated trials, and what is too few does not leave."""

import doctest
import math
from collections import Counter

import pytest
import trials

from hdt_trial import figures, intervals
from hdt_trial.evaluation import evaluate_log
from hdt_trial.page import page

TRIALS = 50


@pytest.fixture(scope="module")
def declared():
    return trials.declaration()


def evaluation(seed, tails, declared):
    units = trials.fleet(seed, tails)
    return evaluate_log(trials.log(units), declared, trials.outcomes(units, declared), {})


def test_every_figure_holds_the_truth_in_88_percent_of_50_trials(declared):
    """Truth: the generator's own account of 800 aircraft, lives whole. Trials: 30 aircraft, 300 sealed flights."""
    truth = trials.truth(trials.fleet(10**6, 800), declared)
    coverage, counts = Counter(), Counter()
    for seed in range(TRIALS):
        for f in evaluation(seed, 30, declared).figures["hdt"]:
            assert f.interval is not None, f
            low, high = (v if v is not None else s * math.inf for v, s in ((f.interval.low, -1), (f.interval.high, 1)))
            coverage[f.name] += low <= truth[f.name] <= high
            counts[f.name] += 1
    assert set(counts) == set(truth)
    assert {name: n for name, n in coverage.items() if n < 0.88 * TRIALS} == {}


def test_a_small_fleet_gives_nothing_away(declared):
    result = evaluation(5, 3, declared)
    assert {f.interval for f in result.figures["hdt"]} == {None}
    assert all(n is None or n == 0 or n >= declared.minimum.count for n in result.verdicts["hdt"].values())


def test_the_page_names_no_aircraft_and_says_what_n_is(declared):
    result = evaluation(5, 30, declared)
    html = page(result)
    assert "T-0" not in html
    assert "AAA" not in html
    assert "per 1,000 flights" in html
    assert "events</td>" in html
    assert result.after_the_fact == 0
    assert "rehearsal" not in html


@pytest.mark.parametrize("module", [figures, intervals])
def test_examples(module):
    assert doctest.testmod(module).failed == 0
