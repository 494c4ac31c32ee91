"""The detector: quiet on noise, quick on shifts, blind to the future."""

import numpy as np
import pytest
from numpy.typing import NDArray

from hdt_core.health.detection import Cusum, Shift, lingering, persistent, since, watch

SD = np.array([0.8])
Flags = NDArray[np.bool_]


def walk(values: NDArray[np.float64], settings: Cusum | None = None) -> Shift:
    return watch(values[:, :, None], SD, np.zeros((*values.shape, 1), dtype=bool), settings)


def calls_of(values: NDArray[np.float64], settings: Cusum | None = None) -> Flags:
    return walk(values, settings).alarm[:, :, 0]


def noise(units: int, flights: int, seed: int = 0, spread: float = 0.8) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    return rng.normal(0.0, spread, (units, flights)) + rng.normal(0.0, 3.0, (units, 1))


def count_raised(calls: Flags) -> int:
    return int((calls & ~np.pad(calls, ((0, 0), (1, 0)))[:, :-1]).sum())


def test_false_calls_stay_within_budget():
    """200 packs, 1,000 flights each; eleven channels share a budget of one call in 1,000 flights of an aircraft."""
    raised = count_raised(calls_of(noise(200, 1000)))
    assert 1000 * raised / (200 * 1000) < 1.0 / 11 / 2


def test_heavy_tails_stay_within_budget():
    tails = 0.8 * np.random.default_rng(1).standard_t(4, (200, 500)) / np.sqrt(2.0)
    assert count_raised(calls_of(tails)) <= 5


@pytest.mark.parametrize(("size", "flights"), [(2.5, 15), (4.0, 5), (6.0, 4)])
def test_step_is_called_soon(size: float, flights: int):
    values = noise(50, 120)
    values[:, 60:] += size * 0.8
    called = calls_of(values)
    assert called[:, :60].sum() == 0
    assert called[:, 60 + flights].mean() > 0.9


def test_drift_is_called():
    drifting = noise(50, 400) + 0.1 * np.maximum(np.arange(400) - 100, 0)
    assert calls_of(drifting)[:, 170].all()


def test_ageing_is_not_called():
    """1 K per 1,000 flights."""
    assert calls_of(noise(50, 400) + 0.001 * np.arange(400)).mean() < 0.01


@pytest.fixture
def short_fault() -> NDArray[np.float64]:
    """Fifty packs with a fault of thirty flights."""
    values = noise(50, 200)
    values[:, 60:90] -= 4.0
    return values


def test_end_of_fault_ends_call(short_fault):
    called = calls_of(short_fault)
    assert called[:, 80].all()
    assert not called[:, 115:].any()


def test_sum_at_limit_is_not_called(short_fault):
    assert not calls_of(short_fault, Cusum(clear=0.0))[:, 199].all()


def test_later_flights_change_no_call():
    values = noise(5, 150)
    values[:, 90:] += 3.0
    whole, part = (walk(v) for v in (values, values[:, :100]))
    np.testing.assert_array_equal(whole.alarm[:, :100], part.alarm)
    np.testing.assert_array_equal(whole.z[:, :100], part.z)


def test_empty_flights_change_no_deviation():
    values = noise(3, 60)
    gaps = np.full((3, 120), np.nan)
    gaps[:, ::2] = values
    np.testing.assert_allclose(walk(gaps).z[:, ::2], walk(values).z)


def walk_by_hand(
    values: NDArray[np.float64], prior_sd: float, restarts: frozenset[int], memory: int
) -> list[tuple[float, ...]]:
    """One series in plain Python: called, z, moved, sums. Page's sums with slack 1 decide at 8 and clear at 2; a flight
    counts 4.5 deviations and a sum 14 at most; ten flights teach before any counts, and calm ones of late with a
    memory; the scatter starts from twenty flights of the expected one, and is half of it at the least."""
    spread = 0.0
    spread_n = 0
    rows = []
    for k, y in enumerate(values):
        if k == 0 or k in restarts:
            offset = None
            n = 0
            on = False
            high = low = departure = 0.0
        if np.isnan(y):
            on = max(high, low) > (2.0 if on else 8.0)
            rows.append((on, 0.0, departure, high, low))
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
def test_cusum_matches_plain_loop(seed: int, scatter: float, memory: int):
    rng = np.random.default_rng(seed)
    values = 3.0 + rng.normal(0.0, scatter, 300)
    values[100:130] += 3.0 * max(scatter, 0.6)
    values[200:] -= 0.05 * max(scatter, 0.6) * np.arange(100)
    values[rng.random(300) < 0.1] = np.nan
    restarts = frozenset({115} if seed == 3 else ())
    new = np.isin(np.arange(300), list(restarts))[None, :, None]
    shift = watch(values[None, :, None], SD, new, Cusum(memory_flights=memory))
    one = [a[0, :, 0] for a in (shift.alarm, shift.z, shift.departure, shift.sum_high, shift.sum_low)]
    np.testing.assert_allclose(np.array(one, dtype=float).T, walk_by_hand(values, 0.8, restarts, memory), atol=1e-9)
    assert shift.alarm.any()


@pytest.mark.parametrize(("z", "first"), [(3.5, [103]), (4.5, [102]), (40.0, [102]), (1.0, [])])
def test_call_delay_follows_shift(z: float, first: list[int]):
    """A shift of z raises the sum by z - 1 a flight, 3.5 at most: it passes 8 with flight 8 / (z - 1), rounded up."""
    values = np.where(np.arange(200) < 100, 0.0, 1.0)
    sd = 0.4 * np.sqrt(1.0 + 1.0 / 100.0)  # never believed below half of the expected scatter
    assert calls_of(values[None, :] * z * sd)[0].nonzero()[0][:1].tolist() == first


def test_restart_forgets_old_unit():
    values = noise(20, 120)
    values[:, 60:] += 5.0
    new = np.zeros((20, 120, 1), dtype=bool)
    new[:, 60] = True
    assert not watch(values[:, :, None], SD, new).alarm.any()


RARE = np.array([[0, 1, 0, 1, 0, 0, 0, 0, 1]], dtype=bool)
KEEP = np.array([[0, 0, 0, 0, 1, 1, 0, 0, 0]], dtype=bool)


def test_persistence_has_hysteresis():
    assert persistent(RARE, 2, 3, 2, keep=KEEP)[0].astype(int).tolist() == [0, 0, 0, 1, 1, 1, 1, 0, 0]


def test_restart_empties_window():
    ended = np.arange(9)[None] == 3
    assert not persistent(RARE, 2, 3, 2, keep=KEEP, restart=ended).any()


EVENTS = np.array([[0, 1, 0, 0, 1]], dtype=bool)


def test_since_counts_from_event():
    assert since(EVENTS)[0].tolist() == [10**6, 0, 1, 2, 0]


def test_event_lingers():
    assert lingering(EVENTS, 1)[0].tolist() == [False, True, True, False, True]


def persistent_by_hand(flags: Flags, keep: Flags, ended: Flags, k: int, n: int, hold: int) -> list[list[bool]]:
    """The rule as it is said: a window that work empties, a call that lasts until nothing has kept it for a while."""
    rows = []
    for flag, hold_flags, end in zip(flags, flags | keep, ended, strict=True):
        recent = [False] * n
        on = False
        quiet = 0
        row = []
        for now, holds, over in zip(flag, hold_flags, end, strict=True):
            recent = [*([False] * n if over else recent)[1:], bool(now)]
            quiet = 0 if holds else quiet + 1
            on = sum(recent) >= k or (on and not over and quiet < hold)
            row.append(on)
        rows.append(row)
    return rows


@pytest.mark.parametrize("seed", range(5))
def test_persistence_matches_plain_loop(seed: int):
    rng = np.random.default_rng(seed)
    for _ in range(60):
        n_flights = int(rng.integers(0, 50))
        often = rng.uniform(0.0, 0.6)
        flags, keep, ended = (rng.random((3, n_flights)) < share for share in (often, often, 0.07))
        n = int(rng.integers(1, 8))
        hold = int(rng.integers(1, 10))
        k = int(rng.integers(1, n + 1))
        result = persistent(flags, k, n, hold, keep=keep, restart=ended)
        assert result.tolist() == persistent_by_hand(flags, keep, ended, k, n, hold)
