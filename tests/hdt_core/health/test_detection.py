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


def test_false_calls_stay_within_budget() -> None:
    # 200 packs, 1,000 flights each; eleven channels share a budget of one call in 1,000 flights of an aircraft
    calls = walked(noise(200, 1000)).alarm[:, :, 0]
    raised = (calls & ~np.pad(calls, ((0, 0), (1, 0)))[:, :-1]).sum()
    assert 1000 * raised / (200 * 1000) < 1.0 / 11 / 2
    rng = np.random.default_rng(1)
    tails = 0.8 * rng.standard_t(4, (200, 500)) / np.sqrt(2.0)
    calls = walked(tails).alarm[:, :, 0]
    assert (calls & ~np.pad(calls, ((0, 0), (1, 0)))[:, :-1]).sum() <= 5


@pytest.mark.parametrize(("size", "flights"), [(2.5, 15), (4.0, 5), (6.0, 4)])
def test_step_is_called_soon(size: float, flights: int) -> None:
    values = noise(50, 120)
    values[:, 60:] += size * 0.8
    called = walked(values).alarm[:, :, 0]
    assert called[:, :60].sum() == 0
    assert called[:, 60 + flights].mean() > 0.9


def test_drift_is_called() -> None:
    flights = np.arange(400)
    drifting = noise(50, 400) + np.where(flights > 100, 0.1 * (flights - 100), 0.0)
    ageing = noise(50, 400) + 0.001 * flights  # 1 K per 1,000 flights
    assert walked(drifting).alarm[:, 170, 0].all()
    assert walked(ageing).alarm.mean() < 0.01
    values = noise(50, 200)
    values[:, 60:90] -= 4.0
    called = walked(values).alarm[:, :, 0]
    assert called[:, 80].all()
    assert not called[:, 115:].any()
    assert not walked(values, Cusum(clear=0.0)).alarm[:, 199, 0].all()  # a sum at the limit is not above it


def test_later_flights_change_no_call() -> None:
    values = noise(5, 150)
    values[:, 90:] += 3.0
    whole, part = walked(values), walked(values[:, :100])
    np.testing.assert_array_equal(whole.alarm[:, :100], part.alarm)
    np.testing.assert_array_equal(whole.z[:, :100], part.z)
    values = noise(3, 60)
    gaps = np.full((3, 120), np.nan)
    gaps[:, ::2] = values
    np.testing.assert_allclose(walked(gaps).z[:, ::2], walked(values).z)


def walked_by_hand(
    values: NDArray[np.float64], prior_sd: float, restarts: frozenset[int], memory: int
) -> list[tuple[float, ...]]:
    """One series in plain Python: called, z, moved, sums. Page's sums with slack 1 decide at 8 and clear at 2; a flight
    counts 4.5 deviations and a sum 14 at most; ten flights teach before any counts, and calm ones of late with a
    memory; the scatter starts from twenty flights of the expected one, and is half of it at the least."""
    offset, n, spread, spread_n, high, low, on, departure = None, 0, 0.0, 0, 0.0, 0.0, False, 0.0
    rows = []
    for k, y in enumerate(values):
        if k in restarts:
            offset, n, high, low, on, departure = None, 0, 0.0, 0.0, False, 0.0
        if np.isnan(y):
            rows.append((on, 0.0, departure, high, low))
            on = max(high, low) > (2.0 if on else 8.0)
            rows[-1] = (on, 0.0, departure, high, low)
            continue
        offset = y if offset is None else offset
        miss = y - offset
        variance = max((20.0 * prior_sd**2 + spread_n * spread) / (20.0 + spread_n), 0.25 * prior_sd**2)
        sd = (variance * (1.0 + 1.0 / max(n, 1))) ** 0.5
        z = miss / sd
        if n >= 10:
            bounded = min(max(z, -4.5), 4.5)
            high = min(max(high + bounded - 1.0, 0.0), 14.0)
            low = min(max(low - bounded - 1.0, 0.0), 14.0)
        worst = max(high, low)
        on = worst > (2.0 if on else 8.0)
        departure = 0.8 * departure + 0.2 * miss if worst > 0.0 else 0.0
        if not on and worst < 4.0:
            bounded = min(max(miss, -3.0 * sd), 3.0 * sd)
            if n > 0:
                weight = 1.0 / min(spread_n + 1, memory)
                spread = (1.0 - weight) * (spread if spread_n else prior_sd**2) + weight * bounded**2 * n / (n + 1.0)
                spread_n = min(spread_n + 1, memory)
            offset += bounded / min(n + 1, memory)
            n += 1
        rows.append((on, z, departure, high, low))
    return rows


@pytest.mark.parametrize(("seed", "scatter", "memory"), [(0, 0.8, 60), (1, 0.1, 1000), (2, 2.0, 60), (3, 0.8, 60)])
def test_cusum_matches_plain_loop(seed: int, scatter: float, memory: int) -> None:
    rng = np.random.default_rng(seed)
    values = 3.0 + rng.normal(0.0, scatter, 300)
    values[100:130] += 3.0 * max(scatter, 0.6)
    values[200:] -= 0.05 * max(scatter, 0.6) * np.arange(100)
    values[rng.random(300) < 0.1] = np.nan
    restarts = frozenset({115} if seed == 3 else ())
    new = np.isin(np.arange(300), list(restarts))[None, :, None]
    shift = watch(values[None, :, None], SD, new, Cusum(memory_flights=memory))
    one = [a[0, :, 0] for a in (shift.alarm, shift.z, shift.departure, shift.sum_high, shift.sum_low)]
    np.testing.assert_allclose(np.array(one, dtype=float).T, walked_by_hand(values, 0.8, restarts, memory), atol=1e-9)
    assert shift.alarm.any()


@pytest.mark.parametrize(("z", "calls_after"), [(3.5, 4), (4.5, 3), (40.0, 3), (1.0, None)])
def test_call_delay_follows_shift(z: float, calls_after: int | None) -> None:
    """A shift of z raises the sum by z - 1 a flight, 3.5 at most: it passes 8 with flight 8 / (z - 1), rounded up."""
    values = np.where(np.arange(200) < 100, 0.0, 1.0)
    sd = 0.4 * np.sqrt(1.0 + 1.0 / 100.0)  # never believed below half of the expected scatter
    called = walked(values[None, :] * z * sd).alarm[0, :, 0]
    assert (int(called.argmax()) - 99 if called.any() else None) == calls_after


def test_restart_forgets_old_unit() -> None:
    values = noise(20, 120)
    values[:, 60:] += 5.0
    new = np.zeros((20, 120, 1), dtype=bool)
    new[:, 60] = True
    assert not watch(values[:, :, None], SD, new).alarm.any()
    flags = np.array([[0, 1, 0, 1, 0, 0, 0, 0, 1]], dtype=bool)
    keep = np.array([[0, 0, 0, 0, 1, 1, 0, 0, 0]], dtype=bool)
    ended = np.zeros_like(flags)
    assert persistent(flags, 2, 3, 2, keep=keep)[0].astype(int).tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0]
    ended[0, 3] = True
    assert not persistent(flags, 2, 3, 2, keep=keep, restart=ended).any()
    events = np.array([[0, 1, 0, 0, 1]], dtype=bool)
    assert since(events)[0].tolist() == [10**6, 0, 1, 2, 0]
    assert lingering(events, 1)[0].tolist() == [False, True, True, False, True]


def flight_by_flight(flags: Flags, keep: Flags, ended: Flags, k: int, n: int, hold: int) -> list[list[bool]]:
    """The rule as it is said: a window that work empties, a call that lasts until nothing has kept it for a while."""
    rows = []
    for flag, hold_flags, end in zip(flags, flags | keep, ended, strict=True):
        recent, on, quiet, row = [False] * n, False, 0, []
        for now, holds, over in zip(flag, hold_flags, end, strict=True):
            recent = [*([False] * n if over else recent)[1:], bool(now)]
            quiet = 0 if holds else quiet + 1
            on = sum(recent) >= k or (on and not over and quiet < hold)
            row.append(on)
        rows.append(row)
    return rows


@pytest.mark.parametrize("seed", range(5))
def test_persistence_matches_plain_loop(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(60):
        shape, often = (3, int(rng.integers(0, 50))), rng.uniform(0.0, 0.6)
        flags, keep, ended = (rng.random(shape) < share for share in (often, often, 0.07))
        n, hold = int(rng.integers(1, 8)), int(rng.integers(1, 10))
        k = int(rng.integers(1, n + 1))
        result = persistent(flags, k, n, hold, keep=keep, restart=ended)
        assert result.tolist() == flight_by_flight(flags, keep, ended, k, n, hold)
