"""Simulated lives end for the reason they should and are seen through the noise they should."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.simulate.episodes import EpisodeSettings, draw_episodes

SMALL = EpisodeSettings(units=300, flights=500)


def test_message_comes_near_the_limit_and_not_before():
    lives = draw_episodes(1, SMALL)
    ended = np.nonzero(lives.message < SMALL.flights)[0]
    at = lives.loss[ended, lives.message[ended]]
    assert np.median(at) == pytest.approx(SMALL.limit_mean, abs=0.03)
    assert at.min() > SMALL.limit_mean - 0.2


def test_hazard_rises_with_loss():
    lives = draw_episodes(2, SMALL)
    k = np.arange(SMALL.flights)[None, :]
    alive = k <= lives.message[:, None]
    hit = k == lives.message[:, None]
    rate = [hit[alive & (lives.loss >= a) & (lives.loss < a + 0.05)].mean() for a in (0.2, 0.3, 0.35, 0.4)]
    assert (np.diff(rate) > 0).all()


def test_noise_is_what_was_asked_for():
    quiet = replace(SMALL, noise_sd=1e-9, drift_sd=0.0, offset_sd=0.01, wash_share=0.0)
    lives = draw_episodes(3, quiet)
    offset = (lives.measured - lives.loss)[lives.age_known, 0]
    assert offset.std() == pytest.approx(0.01, rel=0.2)


def test_washed_units_wear_less():
    washed = draw_episodes(4, replace(SMALL, wash_share=1.0, wash_every_flights=100.0))
    never = draw_episodes(4, replace(SMALL, wash_share=0.0))
    assert washed.loss[:, -1].mean() < 0.7 * never.loss[:, -1].mean()
