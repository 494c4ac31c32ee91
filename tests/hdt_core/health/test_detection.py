"""The detector: quiet on noise, quick on shifts, blind to the future."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hdt_core.health.detection import Cusum, Shift, lingering, persistent, since, watch

SD = np.array([0.8])
Flags = NDArray[np.bool_]


def walked(values: NDArray[np.float64], settings: Cusum | None = None) -> Shift:
    return watch(values[:, :, None], SD, np.zeros((*values.shape, 1), dtype=bool), settings)


def noise(units: int, flights: int, seed: int = 0, spread: float = 0.8) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, spread, (units, flights)) + rng.normal(0.0, 3.0, (units, 1))


def test_false_calls_stay_within_the_budget() -> None:
    # 200 packs, 1,000 flights each; eleven channels share a budget of one call in 1,000 flights of an aircraft
    calls = walked(noise(200, 1000)).called[:, :, 0]
    raised = (calls & ~np.pad(calls, ((0, 0), (1, 0)))[:, :-1]).sum()
    assert 1000 * raised / (200 * 1000) < 1.0 / 11 / 2


def test_heavy_tails_cost_little() -> None:
    rng = np.random.default_rng(1)
    tails = 0.8 * rng.standard_t(4, (200, 500)) / np.sqrt(2.0)
    calls = walked(tails).called[:, :, 0]
    assert (calls & ~np.pad(calls, ((0, 0), (1, 0)))[:, :-1]).sum() <= 5


@pytest.mark.parametrize(("size", "flights"), [(2.5, 15), (4.0, 5), (6.0, 4)])
def test_step_is_called_soon(size: float, flights: int) -> None:
    values = noise(50, 120)
    values[:, 60:] += size * 0.8
    called = walked(values).called[:, :, 0]
    assert called[:, :60].sum() == 0
    assert called[:, 60 + flights].mean() > 0.9


def test_drift_is_called_but_ageing_is_not() -> None:
    flights = np.arange(400)
    drifting = noise(50, 400) + np.where(flights > 100, 0.1 * (flights - 100), 0.0)
    ageing = noise(50, 400) + 0.001 * flights  # 1 K per 1,000 flights
    assert walked(drifting).called[:, 170, 0].all()
    assert walked(ageing).called.mean() < 0.01


def test_a_fault_that_ends_is_seen_to_end() -> None:
    values = noise(50, 200)
    values[:, 60:90] -= 4.0
    called = walked(values).called[:, :, 0]
    assert called[:, 80].all()
    assert not called[:, 115:].any()


def test_nothing_leaks_from_the_future() -> None:
    values = noise(5, 150)
    values[:, 90:] += 3.0
    whole, part = walked(values), walked(values[:, :100])
    np.testing.assert_array_equal(whole.called[:, :100], part.called)
    np.testing.assert_array_equal(whole.z[:, :100], part.z)


def test_a_flight_that_says_nothing_changes_nothing() -> None:
    values = noise(3, 60)
    gaps = np.full((3, 120), np.nan)
    gaps[:, ::2] = values
    np.testing.assert_allclose(walked(gaps).z[:, ::2], walked(values).z)


def test_restart_forgets_the_old_unit() -> None:
    values = noise(20, 120)
    values[:, 60:] += 5.0
    new = np.zeros((20, 120, 1), dtype=bool)
    new[:, 60] = True
    assert not watch(values[:, :, None], SD, new).called.any()


def test_persistence_with_hysteresis_and_end() -> None:
    flags = np.array([[0, 1, 0, 1, 0, 0, 0, 0, 1]], dtype=bool)
    keep = np.array([[0, 0, 0, 0, 1, 1, 0, 0, 0]], dtype=bool)
    ended = np.zeros_like(flags)
    assert persistent(flags, 2, 3, 2, keep=keep)[0].astype(int).tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0]
    ended[0, 3] = True
    assert not persistent(flags, 2, 3, 2, keep=keep, ended=ended).any()


def flight_by_flight(flags: Flags, keep: Flags, ended: Flags, k: int, n: int, hold: int) -> list[list[bool]]:
    """The rule as it is said: a window that work empties, a call that lasts until nothing has kept it for a while."""
    told = []
    for flag, kept, end in zip(flags, flags | keep, ended, strict=True):
        recent, on, quiet, said = [False] * n, False, 0, []
        for now, holds, over in zip(flag, kept, end, strict=True):
            recent = [*([False] * n if over else recent)[1:], bool(now)]
            quiet = 0 if holds else quiet + 1
            on = sum(recent) >= k or (on and not over and quiet < hold)
            said.append(on)
        told.append(said)
    return told


@pytest.mark.parametrize("seed", range(5))
def test_persistence_all_at_once_is_that_of_flight_by_flight(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(60):
        shape, often = (3, int(rng.integers(0, 50))), rng.uniform(0.0, 0.6)
        flags, keep, ended = (rng.random(shape) < share for share in (often, often, 0.07))
        n, hold = int(rng.integers(1, 8)), int(rng.integers(1, 10))
        k = int(rng.integers(1, n + 1))
        found = persistent(flags, k, n, hold, keep=keep, ended=ended)
        assert found.tolist() == flight_by_flight(flags, keep, ended, k, n, hold)


def test_flights_since() -> None:
    events = np.array([[0, 1, 0, 0, 1]], dtype=bool)
    assert since(events)[0].tolist() == [10**6, 0, 1, 2, 0]
    assert lingering(events, 1)[0].tolist() == [False, True, True, False, True]
