"""The signature matrix names what moved, and says so when it can't know."""

import numpy as np
import pytest

from hdt_core.alerts.signatures import CHANNELS, HX_STEP, NO_SENSOR, classify, signatures

KNOWN = signatures()
SENSORS = [k for k, (name, _) in enumerate(KNOWN.names) if name not in NO_SENSOR]
FLIGHTS = 9.0
AT = {c.name: k for k, c in enumerate((*CHANNELS, HX_STEP))}


def told(k: int, size: float, rng: np.random.Generator) -> np.ndarray:
    """Shifts of nine flights under hypothesis k; one inlet law at a time, as aircraft record it."""
    z = size * np.sqrt(FLIGHTS) * KNOWN.shift[k] + rng.standard_normal(KNOWN.shift.shape[1])
    z[[AT["hx_in_over_pressure_k"], AT["hx_in_over_pressure_k"] + len(AT)]] = np.nan
    return z


@pytest.mark.parametrize("k", SENSORS, ids=lambda k: "-".join(KNOWN.names[k]))
@pytest.mark.parametrize("size", [-1.0, 1.0])
def test_names_the_sensor_and_the_pack(k: int, size: float) -> None:
    rng = np.random.default_rng(k)
    hits = [classify(told(k, size, rng), FLIGHTS)[0][:2] == KNOWN.names[k] for _ in range(20)]
    # what only the hot inlet's law sees may be its own sensor or the discharge's
    assert np.mean(hits) >= (0.8 if KNOWN.names[k][0] not in ("cc_out_k", "hx_in_k") else 0.3)


@pytest.mark.parametrize("sensor", ["hx_in_k", "ram_door_open"])
def test_the_hot_inlet_and_the_door_are_not_taken_for_wear(sensor: str) -> None:
    z = told(KNOWN.names.index((sensor, "own")), 1.0, np.random.default_rng(1))
    blamed = sum(p for name, whose, p in classify(z, FLIGHTS) if name not in NO_SENSOR and whose != "other")
    assert blamed > 0.95


def test_does_not_name_what_it_cannot_know() -> None:
    # left against right alone can't tell whose outlet it is
    z = np.full(KNOWN.shift.shape[1], np.nan)
    z[AT["hx_out_between_packs_k"]] = 12.0
    assert classify(z)[0][2] == pytest.approx(0.5, abs=0.02)


def test_probabilities_add_up_with_channels_missing() -> None:
    z = 5.0 * KNOWN.shift[0]
    z[3:] = np.nan
    assert sum(p for _, _, p in classify(z)) == pytest.approx(1.0)


@pytest.mark.parametrize("inlet", [-2.0, 0.0, 3.0])
def test_a_real_step_of_the_exchanger_is_no_sensor(inlet: float) -> None:
    z = np.zeros(KNOWN.shift.shape[1])
    # a blockage takes ram flow, too, and the hot inlet feels it
    z[AT["hx_fouling_flight"]], z[AT["hx_in_over_discharge_k"]] = 12.0, inlet
    z[AT["hx_in_over_pressure_k"]] = np.nan
    assert classify(z)[0][:2] == ("hx", "own")


def test_chance_is_no_fault() -> None:
    rng = np.random.default_rng(3)
    quiet = [classify(rng.standard_normal(KNOWN.shift.shape[1]), FLIGHTS) for _ in range(50)]
    worst = max(sum(p for name, _, p in one if name not in NO_SENSOR) for one in quiet)
    assert worst < 0.5
