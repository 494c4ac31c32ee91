"""Flights recorded with the packs exchanged, by what distinguishes the two packs."""

import numpy as np
import polars as pl
import pytest

from hdt_core.record.exchange import BETWEEN_PACKS, EXCHANGED, are_reversed, exchanged_packs
from hdt_core.record.judge import judge_flights
from hdt_core.record.usable import usable_rows
from tests.support.flight_lists import NOW, fleet

N_FLIGHTS = 90
OFFSETS = dict(zip(BETWEEN_PACKS, (3.0, -2.0, 1.5, 0.0, -1.2, 0.3, 2.0, 0.0), strict=True))
"""How the packs differ, in standard deviations from flight to flight."""


def simulate_flights(offsets: dict[str, float], signs: np.ndarray) -> pl.DataFrame:
    """An aircraft's flights, of which some have the packs exchanged: sign -1."""
    rng = np.random.default_rng(5)
    flights = fleet(N_FLIGHTS // 3, 1)
    values = {name: signs * (offset + rng.normal(0.0, 1.0, N_FLIGHTS)) for name, offset in offsets.items()}
    return flights.with_columns(pl.Series(name, column) for name, column in values.items())


def exchange_between(first: int, after_last: int = N_FLIGHTS) -> np.ndarray:
    """Signs of an aircraft's flights of which these have the packs exchanged."""
    signs = np.ones(N_FLIGHTS)
    signs[first:after_last] = -1.0
    return signs


def flip_signals(flights: pl.DataFrame, first: int, *names: str) -> pl.DataFrame:
    """Flights whose signals of these names change sign from one on."""
    is_late = pl.int_range(pl.len()) >= first
    changed = (pl.when(is_late).then(-pl.col(name)).otherwise(name) for name in names)
    return flights.sort("departed_at").with_columns(changed)


def find_held_places(flights: pl.DataFrame) -> list[int]:
    """Places of the held flights, in order of departure."""
    rows = flights.sort("departed_at").with_row_index().join(exchanged_packs(flights), on="flight_id", how="semi")
    return sorted(rows["index"].to_list())


@pytest.mark.parametrize(("first", "after_last"), [(40, N_FLIGHTS), (30, 60), (50, 57), (12, N_FLIGHTS)])
def test_exchanged_flights_are_held(first, after_last):
    places = find_held_places(simulate_flights(OFFSETS, exchange_between(first, after_last)))

    wrong = set(places) ^ set(range(first, after_last))
    assert len(wrong) <= 2


def test_exchange_follows_departures():
    """The ids of the flights run the other way."""
    flights = simulate_flights(OFFSETS, exchange_between(70)).sort("departed_at")

    places = find_held_places(flights.with_columns(pl.col("flight_id").reverse()))

    assert min(places) in range(69, 72)


def test_unexchanged_packs_are_not_held():
    assert find_held_places(simulate_flights(OFFSETS, np.ones(N_FLIGHTS))) == []


def test_exchange_survives_sensor_change():
    """A sensor that is changed as the packs are exchanged back."""
    flights = simulate_flights(dict.fromkeys(OFFSETS, 3.0), exchange_between(30, 60))

    assert find_held_places(flip_signals(flights, 60, "hx_in_between_packs_k")) == list(range(30, 60))


@pytest.mark.parametrize("name", ["hx_out_between_packs_k", "hx_in_between_packs_k"])
def test_single_sign_change_is_ignored(name):
    flights = simulate_flights(OFFSETS, np.ones(N_FLIGHTS))

    assert find_held_places(flip_signals(flights, 45, name)) == []


def test_changed_flow_is_no_exchange():
    flights = simulate_flights(OFFSETS, np.ones(N_FLIGHTS))
    of_flow = [name for name in BETWEEN_PACKS if not name.endswith("_k")]

    assert find_held_places(flip_signals(flights, 45, *of_flow)) == []


def test_like_packs_are_not_held():
    assert find_held_places(simulate_flights(dict.fromkeys(OFFSETS, 0.2), exchange_between(40))) == []


def test_missing_channel_is_left_out():
    flights = simulate_flights(OFFSETS, exchange_between(40))
    flights = flights.with_columns(pl.lit(None, pl.Float64).alias("cc_out_between_packs_pa"))

    assert find_held_places(flights) == list(range(40, N_FLIGHTS))


def test_judge_names_the_exchange():
    no_deliveries = pl.DataFrame(schema={"operator": pl.String, "tail": pl.String, "delivered_on": pl.Date})

    rows = judge_flights(simulate_flights(OFFSETS, exchange_between(40)), no_deliveries, NOW)

    assert rows["reason"].unique().to_list() == ["packs_exchanged"]


def test_exchanged_packs_are_swapped_back():
    key = {"operator": "AQX", "tail": "LX-AA0"}
    rows = pl.DataFrame([key | {"flight_id": f, "pack": p} for f in "abc" for p in (1, 2)])
    reasons = pl.DataFrame(
        [
            key | {"flight_id": "b", "reason": EXCHANGED, "is_used": True, "without_log": False},
            key | {"flight_id": "c", "reason": "no_flight", "is_used": False, "without_log": False},
        ]
    )

    used = usable_rows(rows, reasons)

    assert used.select("flight_id", "pack").rows() == [("a", 1), ("a", 2), ("b", 2), ("b", 1)]


NAMES = list(BETWEEN_PACKS)
THREE = ("hx_in_between_packs_k", "hx_out_between_packs_k", "cc_out_between_packs_pa")
KELVIN = ("hx_in_between_packs_k", "hx_out_between_packs_k", "cc_in_between_packs_k")
OTHERS = ("ram_door_between_packs", "pack_flow_between_packs_kg_s", "cc_out_between_packs_pa")


def differences(**values: float) -> np.ndarray:
    """How two packs differ, in standard deviations; 0 where not given."""
    return np.array([[values.get(name, 0.0) for name in NAMES]])


def reversed_by(ratio: float, before: float = 2.0, names: tuple[str, ...] = THREE) -> bool:
    """Whether packs that differ so much in these signals changed places where each difference is multiplied."""
    usual = differences(**dict.fromkeys(names, before))
    return bool(are_reversed(usual, ratio * usual)[0])


@pytest.mark.parametrize(("names", "are"), [(THREE, True), (THREE[1:], False), (KELVIN, False), (OTHERS, False)])
def test_exchange_shows_in_both_kinds(names, are):
    """Three signals, of which one is a temperature and another is none."""
    assert reversed_by(-1.0, names=names, before=3.0) is are


@pytest.mark.parametrize(("before", "are"), [(1.42, True), (1.41, False)])
def test_exchange_needs_evidence(before, are):
    """Five flights of three signals: 15 times the square above 30."""
    assert reversed_by(-1.0, before=before) is are


@pytest.mark.parametrize(("ratio", "are"), [(-0.41, True), (-0.39, False), (-1.59, True), (-1.61, False)])
def test_exchange_keeps_size(ratio, are):
    assert reversed_by(ratio) is are


@pytest.mark.parametrize(("third", "are"), [(-0.21, True), (-0.19, False)])
def test_each_clear_difference_is_reversed(third, are):
    before = differences(**dict.fromkeys(THREE, 2.0))
    after = before * np.where(np.array(NAMES) == THREE[2], third, -1.0)

    assert bool(are_reversed(before, after)[0]) is are


@pytest.mark.parametrize(("share", "are"), [(0.75, True), (0.76, False)])
def test_known_exchange_needs_share(share, are):
    """Three of four clear differences."""
    before = differences(**dict.fromkeys((*THREE, OTHERS[0]), 2.0))
    after = before * np.where(np.array(NAMES) == OTHERS[0], 1.0, -1.0)

    assert bool(are_reversed(before, after, share)[0]) is are


@pytest.mark.parametrize(("small", "n"), [(0.79, 3), (0.81, 4)])
def test_small_difference_is_not_clear(small, n):
    """One that keeps its sign forbids the exchange, but where it is too small to count."""
    before = differences(**dict.fromkeys(THREE, 2.0), **{OTHERS[0]: small})
    after = before * np.where(np.array(NAMES) == OTHERS[0], 1.0, -1.0)

    assert bool(are_reversed(before, after)[0]) is (n == 3)
