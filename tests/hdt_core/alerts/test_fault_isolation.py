"""Medians of late flights, of which a channel may have measured any number; records that end while one doubts."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from hdt_core.alerts import fault_isolation
from hdt_core.alerts.fault_isolation import MEDIAN_WORTH, Indications, _median_z
from hdt_core.alerts.grid import Grid
from hdt_core.alerts.signatures import CHANNELS
from hdt_core.health.detection import Shift, watch


@pytest.mark.parametrize("flights", [0, 1, 2, 5, 12])
def test_medians_of_what_was_measured_are_numpys(flights):
    rng = np.random.default_rng(flights)
    z = rng.standard_normal((flights, 40))
    z[rng.random(z.shape) < 0.4] = np.nan
    z[rng.random(z.shape) < 0.2] = 0.0  # a spike that was taken out
    middle, worth = _median_z(z)
    for k, column in enumerate(z.T):
        values = column[np.isfinite(column) & (column != 0.0)]
        assert worth[k] == (max(values.size, 1e-9) if values.size < 3 else MEDIAN_WORTH * values.size)
        assert np.isnan(middle[k]) if not values.size else middle[k] == np.median(values) * np.sqrt(worth[k])


def test_a_doubt_that_outlasts_the_record_is_left_open() -> None:
    """The last aircraft has the shorter record: what the grid holds beyond it is padding and no flight."""
    flown = [(tail, f, p) for tail, flights in (("T-1", 60), ("T-2", 30)) for f in range(flights) for p in (1, 2)]
    rows = pl.DataFrame(flown, schema=["tail", "flight", "pack"], orient="row").with_columns(
        pl.col("pack").cast(pl.Int32),
        operator=pl.lit("TST"),
        flight_id=pl.col("tail") + pl.col("flight").cast(pl.String),
        departed_at=datetime(2024, 1, 1, tzinfo=UTC) + pl.col("flight") * timedelta(hours=6),
    )
    grid = Grid.from_frame(rows)
    still = np.where(grid.is_flight[:, :, None], np.zeros(len(CHANNELS)), np.nan)
    shift = watch(still, np.array([c.sd for c in CHANNELS]), np.zeros(still.shape, dtype=bool))
    evidence = Indications(grid, shift, np.zeros(grid.shape), grid.partner())
    assert [evidence.isolate(0, (unit, 25, None)) for unit in range(4)] == [None] * 4
    assert evidence.isolate(0, (3, 25, 40)) is None


def two_packs(flights: int) -> Grid:
    """Two packs of one aircraft, the second without the fourth flight of all."""
    flown = [(f, p) for f in range(flights) for p in (1, 2) if (f, p) != (3, 2)]
    rows = pl.DataFrame(flown, schema=["flight", "pack"], orient="row").with_columns(
        pl.col("pack").cast(pl.Int32), operator=pl.lit("TST"), tail=pl.lit("T"),
        flight_id=pl.col("flight").cast(pl.String),
        departed_at=datetime(2024, 1, 1, tzinfo=UTC) + pl.col("flight") * timedelta(hours=6),
    )  # fmt: skip
    return Grid.from_frame(rows)


def told_by_hand(z: np.ndarray, loss: np.ndarray, k: int, first: int) -> tuple[list[float], list[float]]:
    """Medians of the last four to twelve flights, two thirds of a flight worth each; and the loss since it began
    against that of the twenty flights up to eight before it, which wear of .001 a flight may have moved meanwhile."""
    n = min(max(k - first + 4, 4), 12)
    late = np.arange(max(k - n + 1, 0), k + 1)
    middles, worths = [], []
    for column in z[late].T:
        values = column[np.isfinite(column) & (column != 0.0)]
        worth = len(values) * (2.0 / np.pi if len(values) > 2 else 1.0)
        middles.append(np.median(values) * np.sqrt(worth))
        worths.append(worth)
    before = np.arange(max(first - 28, 0), max(first - 8, 0))
    now, then = loss[late][np.isfinite(loss[late])], loss[before][np.isfinite(loss[before])]
    between = late.mean() + 0.5 - (before[0] + before[-1] + 1) / 2.0
    sd = np.sqrt(0.016**2 * np.pi / 2.0 * (1.0 / len(now) + 1.0 / len(then)) + (1e-3 * between) ** 2)
    return [*middles, (np.median(now) - np.median(then)) / sd], [*worths, (0.016 / sd) ** 2]


@pytest.mark.parametrize(("k", "first"), [(40, 40), (45, 40), (55, 40), (12, 12)])
def test_what_is_looked_at_is_the_late_flights_of_both_packs(k: int, first: int) -> None:
    rng, grid = np.random.default_rng(3), two_packs(60)
    z, loss = rng.normal(size=(2, 60, 15)), rng.normal(0.1, 0.02, (2, 60))
    loss[:, ::7] = np.nan
    if k == 40:
        loss[:, 37:40] = np.nan  # one late flight is known
    shift = Shift(np.zeros(z.shape, bool), z, z, np.zeros(z.shape), np.zeros(z.shape))
    indications = Indications(grid, shift, loss, grid.partner())
    (shifts,), (worth,) = indications.shifts_at(0, np.array([k]), first)
    mine, theirs = told_by_hand(z[0], loss[0], k, first), told_by_hand(z[1], loss[1], k - 1, first - 1)
    assert shifts.tolist() == pytest.approx(mine[0] + theirs[0])
    assert worth.tolist() == pytest.approx(mine[1] + theirs[1])
    assert indications.same_time(0, np.array([2, 3, 4]), 1).tolist() == [2, 2, 3]
    lone = Indications(grid, shift, loss, np.array([-1, -1]))
    (shifts,), (worth,) = lone.shifts_at(0, np.array([k]), first)
    assert np.isnan(shifts[16:]).all()
    assert worth[16:].tolist() == [1.0] * 16


def named(monkeypatch, classify: object, end: int | None = None) -> tuple[int, dict[str, object]] | None:
    """Who is named where the classifier says so on each flight from the twentieth on."""
    grid, flight = two_packs(150), iter(range(20, 150))
    z = np.ones((2, 150, 15))
    shift = Shift(z > 0, z, 2.0 * z, z, z)
    monkeypatch.setattr(fault_isolation, "classify", lambda z, flights: classify(next(flight)))
    return Indications(grid, shift, np.zeros((2, 150)), grid.partner()).isolate(4, (0, 20, end))


def test_a_sensor_is_named_with_probability_95_per_cent(monkeypatch) -> None:
    def classify(k: int) -> list[tuple[str, str, float]]:
        mine = 0.951 if k >= 30 else 0.949
        return [("mach", "own", mine - 0.1), ("tat_k", "both", 0.1), ("hx", "own", 0.03), ("nothing", "own", 0.01)]

    flight, facts = named(monkeypatch, classify)
    assert flight == 30
    assert facts == {
        "sensor": "mach", "whose": "own", "p": pytest.approx(0.951), "biased": True, "channel": "tat_between_packs_k",
        "moved": 2.0, "sigma": pytest.approx(np.sqrt(12 * 2.0 / np.pi)),
    }  # fmt: skip


@pytest.mark.parametrize(
    ("p", "from_flight", "name"), [(0.991, 20, None), (0.989, 20, 40), (0.991, 26, None), (0.991, 24, 40)]
)
def test_the_other_packs_sensor_ends_the_search_from_the_sixth_flight_on(monkeypatch, p, from_flight, name) -> None:
    def classify(k: int) -> list[tuple[str, str, float]]:
        theirs = p if (from_flight <= k < from_flight + 1 or from_flight == 20) and k < 40 else 0.0
        return [("mach", "other", theirs), ("hx", "other", 0.0), ("tat_k", "own", 0.96 if k >= 40 else 0.0)]

    isolated = named(monkeypatch, classify)
    assert (isolated and isolated[0]) == name


@pytest.mark.parametrize(
    ("sure_at", "end", "name"), [(119, None, 119), (120, None, None), (59, 60, 59), (60, 60, None)]
)
def test_a_shift_waits_a_hundred_flights_for_its_name(monkeypatch, sure_at, end, name) -> None:
    isolated = named(monkeypatch, lambda k: [("mach", "own", 0.96 * (k >= sure_at))], end)
    assert (isolated and isolated[0]) == name
