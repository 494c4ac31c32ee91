"""Scores of censored lives on cases whose answer is known."""

import numpy as np
import polars as pl
import pytest

from benchmarks.held_out import censored_scores


def lives(n: int, cut: float, seed: int = 0) -> pl.DataFrame:
    """Lives of constant hazards, each with its own true risk within 100 flights; cut at random with rate `cut`."""
    rng = np.random.default_rng(seed)
    rate = rng.choice([1 / 30, 1 / 100, 1 / 400], n)
    life = rng.exponential(1.0 / rate)
    end = rng.exponential(1.0 / cut, n)
    return pl.DataFrame(
        {
            "remaining": np.minimum(life, end) + 1e-3,
            "failed": life <= end,
            "true": 1.0 - np.exp(-100.0 * rate),
            "none": 0.5,
        }
    )


def test_ignorance_scores_as_coin():
    scores = censored_scores(lives(3000, 1 / 500), "none")
    assert scores["c_index"] == pytest.approx(0.5)
    assert scores["brier_100_skill"] < 0.0


def test_censoring_moves_no_score():
    """That is what the weights are for: without them the share of failures seen would."""
    whole, cut = (censored_scores(lives(20_000, rate), "true") for rate in (1e-6, 1 / 200))
    assert cut["c_index"] == pytest.approx(whole["c_index"], abs=0.01)
    assert cut["brier_100_skill"] == pytest.approx(whole["brier_100_skill"], abs=0.02)
