"""Compressor health: a first flight by hand, recovery of a known loss, renewals, gaps and what was not recorded."""

from itertools import product

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, log
from scipy.stats import norm

from hdt_core.tracking.component import scatter_by_segment
from hdt_core.tracking.track import effective_diameter
from hdt_core.tracking.track import track_compressor as tracked

LOSSES = {"cc_efficiency_loss": (0.25, 0.008, 0.01, 0.006), "cc_diameter_loss": (1.0 - 0.75**0.5, 0.04, 0.0, 0.02)}
"""Loss at failure, spread of machines, error of the fleet's level, scatter of a flight."""
PACES = [(0.45, 1.5e-4, 2e-4), (0.45, 1e-3, 8e-4), (0.10, 6e-3, 4e-3)]
ENTRY = [(0.85, 0.0033, 0.025), (0.15, 0.083, 0.05)]


def track(twin: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    return pl.concat(result.health for result in tracked(twin, maintenance, DSM))


def parameter(rows: pl.DataFrame, name: str) -> pl.DataFrame:
    return rows.filter(pl.col("parameter") == name).sort("tail", "pack", "departed_at")


def machines(loss: np.ndarray, **columns: object) -> pl.DataFrame:
    """A flight a day of a machine whose efficiency and effective diameter are lower by this much."""
    efficiency = 0.8 * (1.0 - loss)
    diameter = 0.17 * (1.0 - loss)
    readings = {"efficiency": efficiency.tolist(), "diameter_m": diameter.tolist(), "expected_diameter_m": 0.17}
    return flights(len(loss), **({"cc_n_samples": 9, "cc_status": None} | readings | columns))


@pytest.mark.parametrize("name", LOSSES)
def test_first_flight_weighs_every_hypothesis(name):
    """In units where failure is the exchanger's, 38 % lost; lives are five times the exchanger's."""
    failure, unit_sd, level_sd, scatter = LOSSES[name]
    size = np.log(1.0 - failure) / np.log(0.62)
    offsets = (unit_sd / size) ** 2 + max((0.02**2 - unit_sd**2) / size**2, 0.015**2)  # of 2 % over machines
    rows = []
    for (share, rate, rate_sd), (part, wear, wear_sd) in product(PACES, ENTRY):
        mean = wear + rate / 5.0
        variance = wear_sd**2 + (rate_sd / 5.0) ** 2 + (0.001 / size) ** 2
        residual = -np.log(1.0 - 0.008) / size - mean
        s = variance + offsets + 0.005**2 + (scatter / size) ** 2
        sound = 0.99 * norm.pdf(residual, 0.0, s**0.5)
        odd = 0.01 * norm.pdf(residual, 0.0, (s + 0.3**2) ** 0.5)
        use = sound / (sound + odd)
        shift = variance / s * residual
        spread = variance - use * variance**2 / s + use * (1.0 - use) * shift**2
        rows.append((share * part * (sound + odd), mean + use * shift, spread))
    weight, mean, variance = np.array(rows).T
    weight /= weight.sum()
    middle = weight @ mean
    sd = np.sqrt(weight @ (variance + (mean - middle) ** 2))
    row = parameter(track(machines(np.array([0.008])), log()), name).row(0, named=True)
    left = np.exp(-size * middle)
    assert row["value"] == pytest.approx(1.0 - left, rel=1e-6)
    assert row["sd"] == pytest.approx(left * np.hypot(size * sd, level_sd), rel=1e-6)  # the level's error stays
    assert (row["component"], row["unit"], row["estimator"]) == ("CC", "-", "nls, filtered")


LOSS = np.r_[np.zeros(40), np.linspace(0.0, 0.1, 100), np.zeros(60)]
"""Ten per cent over a hundred flights; the log names another machine then."""


@pytest.fixture(scope="module", params=LOSSES)
def tracks(request) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Filtered and smoothed track of a known loss."""
    rng = np.random.default_rng(5)
    noisy = 1.0 - (1.0 - LOSS) * np.exp(LOSSES[request.param][-1] * rng.standard_normal(200))
    rows = track(machines(noisy), log(("T-1", 1, "CC", "REPLACED", 139)))
    return parameter(rows, request.param), parameter(rows, f"{request.param}_smoothed")


def test_recovers_known_loss(tracks):
    filtered, _ = tracks
    error = filtered["value"].to_numpy() - LOSS
    assert np.abs(error[[39, 139, 199]]).max() < 0.02
    assert (np.abs(error) < 1.645 * filtered["sd"].to_numpy()).mean() > 0.9


def test_smoothing_calms_the_loss(tracks):
    rough, smooth = (np.diff(rows["value"].to_numpy() - LOSS)[:138].std() for rows in tracks)
    assert smooth < 0.5 * rough
    assert tracks[1]["estimator"].unique().to_list() == ["nls, smoothed"]


def test_new_machine_has_no_loss(tracks):
    assert abs(tracks[0]["value"][140]) < 0.02


@pytest.fixture(scope="module")
def losses() -> np.ndarray:
    return np.linspace(0.0, 0.05, 120) + 0.006 * np.random.default_rng(6).standard_normal(120)


@pytest.fixture(scope="module")
def whole(losses) -> pl.DataFrame:
    return track(machines(losses), log())


@pytest.mark.parametrize("end", [30, 50, 70, 101])
def test_later_flights_change_no_loss(losses, whole, end):
    early = track(machines(losses[:end]), log())
    for name in LOSSES:
        assert parameter(early, name).equals(parameter(whole, name).head(end))


def test_diameter_is_the_flights_own():
    """A quarter of a per cent by the probes, and the error of a median of so many samples of 0.3 %."""
    twin = flights(
        3, efficiency=0.8, diameter_m=0.16, expected_diameter_m=0.17, cc_status=None, cc_n_samples=[0, 1, 30]
    )
    rows = effective_diameter(twin)
    assert rows["value"].to_list() == [0.16] * 3
    noise = 0.003 * 1.2533 / np.sqrt([1.0, 1.0, 30.0])
    np.testing.assert_allclose(rows["sd"], 0.16 * np.hypot(0.0025, noise), rtol=1e-9)
    assert rows["status"].to_list() == ["predicted", "ok", "ok"]
    assert rows.select("unit", "estimator").unique().rows() == [("m", "nls")]


EARLY = 1.4826 * 0.02 / 2**0.5
LATE = 1.4826 * 0.06 / 2**0.5


@pytest.mark.parametrize(
    ("usual_sd", "own_sd", "expected"),
    [
        (0.006, 0.0, [0.006, EARLY, LATE]),
        (None, 0.0, [EARLY, EARLY, LATE]),
        (None, 0.01, [np.sqrt(s**2 - 0.01**2) for s in (EARLY, EARLY, LATE)]),
    ],
)
def test_scatter_follows_earlier_segments(usual_sd, own_sd, expected):
    """The usual scatter for fifty flights, then that of all steps before the segment: none of its own or later.

    Without a usual one the first fifty have their own.
    """
    ratio = np.r_[np.tile([0.0, 0.02], 25), np.tile([0.0, 0.06], 35)]
    ratio[1:40:3] = np.nan
    scatter = scatter_by_segment(flights(120), ratio, np.full(120, own_sd**2), usual_sd)
    np.testing.assert_allclose(scatter, np.repeat(expected, [50, 50, 20]), rtol=1e-4)


@pytest.fixture
def machine() -> pl.DataFrame:
    """A machine that loses, jumps, falls silent and is replaced before its eleventh flight."""
    wear = [None, 0.01, 0.012, 0.2, 0.013, None, 0.02, 0.022, 0.025, 0.03, -0.01, 0.0]
    ratio = np.exp(-np.array(wear, float))
    return flights(
        12, efficiency=pl.Series(0.8 * ratio, nan_to_null=True).fill_nan(None).to_list(),
        diameter_m=pl.Series(0.17 * ratio).fill_nan(None).to_list(), expected_diameter_m=0.17,
        cc_status=None, cc_n_samples=pl.Series([0, *[9] * 4, 0, *[9] * 6]).to_list(),
    )  # fmt: skip


@pytest.mark.parametrize("loss", LOSSES)
def test_loss_begins_with_first_reading(machine, loss):
    rows = track(machine, log(("T-1", 1, "CC", "REPLACED", 9)))
    filtered = parameter(rows, loss)
    assert filtered["status"].to_list() == ["not_recorded", *["ok"] * 4, "predicted", *["ok"] * 6]
    assert filtered["value"].null_count() == filtered["sd"].null_count() == 1
    assert parameter(rows, f"{loss}_smoothed").height == 11
    assert filtered["value"][3] < 0.03  # a flight far off is more likely a bad flight than a bad machine


def test_packs_are_filtered_separately(machine):
    two = pl.concat([machine, machine.with_columns(pack=pl.lit(2, pl.Int32))])
    both, alone = (track(rows, log()) for rows in (two, machine))
    assert both.height == 2 * alone.height
    for name in LOSSES:
        assert parameter(both.filter(pack=2), name).drop("pack").equals(parameter(alone, name).drop("pack"))


def test_no_flights_give_no_rows(machine):
    assert track(machine.clear(), log()).is_empty()


def test_exchanger_replacement_leaves_compressor(machine):
    with_log, without = (track(machine, entries) for entries in (log(("T-1", 1, "HX", "REPLACED", 9)), log()))
    assert with_log.equals(without)


def test_impossible_reading_is_missing(machine):
    odd, blank = (
        machine.with_columns(efficiency=pl.when(pl.int_range(12) == 4).then(value).otherwise("efficiency"))
        for value in (-1.0, None)
    )
    assert track(odd, log()).equals(track(blank, log()))


def test_unrecorded_efficiency_has_no_loss(machine):
    never = track(machine.with_columns(efficiency=pl.lit(None, pl.Float64)), log())
    rows = parameter(never, "cc_efficiency_loss")
    assert rows["status"].unique().to_list() == ["not_recorded"]
    assert rows["value"].null_count() == rows["sd"].null_count() == 12
