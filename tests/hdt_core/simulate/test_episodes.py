"""Simulated lives end for the reason they should and are seen through the noise they should."""

from dataclasses import replace

import numpy as np
import pytest

from hdt_core.simulate.episodes import LEAD, EpisodeSettings, draw_episodes
from hdt_core.simulate.training import join_unlogged_lives

SMALL = EpisodeSettings(aircraft=40, flights=400)


def test_the_message_comes_on_the_second_hot_flight_of_three():
    lives = draw_episodes(1, SMALL)
    ended = np.nonzero(lives.message < SMALL.flights)[0]
    assert ended.size > 10
    hot = lives.overheat_k > SMALL.rule.excess_k
    for unit in ended:
        end = lives.message[unit]
        assert hot[unit, end]
        assert hot[unit, max(end - 2, 0) : end].any()
        assert not (hot[unit, 1:end] & hot[unit, : end - 1]).any()


def test_lives_end_where_flights_ask_for_more_than_is_left():
    exact = replace(SMALL, noise_sd=1e-9, drift_sd=0.0, map_error=0.0, pack_error=0.0)
    lives = draw_episodes(2, exact)
    ended = np.nonzero(lives.message < SMALL.flights)[0]
    demand = lives.demand[ended, LEAD + lives.message[ended]]
    # the flight's own scatter in what it is said to ask is 0.015
    assert (lives.ratio[ended, lives.message[ended]] < demand + 0.06).all()


def test_hazard_rises_with_loss():
    lives = draw_episodes(2, SMALL)
    left, failed = lives.remaining()
    at = (left >= 0) & failed
    soon = [(left[at & (lives.loss >= a) & (lives.loss < a + 0.1)] < 30).mean() for a in (0.0, 0.1, 0.2)]
    assert (np.diff(soon) > 0).all()


def test_noise_is_what_was_asked_for():
    quiet = replace(SMALL, noise_sd=1e-9, drift_sd=0.0, offset_sd=0.02, wash_share=0.0)
    lives = draw_episodes(3, quiet)
    offset = (lives.estimated_loss - lives.loss)[lives.age_known, 0]
    assert offset.std() == pytest.approx(0.01, rel=0.25)


def test_washed_units_wear_less():
    washed = draw_episodes(4, replace(SMALL, wash_share=1.0, wash_every_flights=100.0))
    never = draw_episodes(4, replace(SMALL, wash_share=0.0))
    assert washed.loss[:, -1].mean() < 0.7 * never.loss[:, -1].mean()


def test_an_unlogged_record_goes_on_with_the_next_unit_and_its_message():
    lives = draw_episodes(5, SMALL)
    joined = join_unlogged_lives(np.random.default_rng(0), lives)
    left, failed = joined.remaining()
    unit = int(np.argmin(lives.message))
    assert left[unit, 0] == lives.message[unit]
    assert joined.loss[unit, lives.message[unit] + 12] < lives.loss[unit, lives.message[unit]]
    after = joined.message[unit]
    assert failed[unit, lives.message[unit] + 1] == (after < SMALL.flights)
