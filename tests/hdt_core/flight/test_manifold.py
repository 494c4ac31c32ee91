"""The conductance index by hand, its slopes; wear, unrest and strays at their edges; distance from a nominal fleet."""

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2
from twin_flights import NO_LOG

from hdt_core.flight import conductance_index
from hdt_core.flight.admission import Scatter, learn_scatter
from hdt_core.flight.conductance_index import (
    TERMS,
    IndexLevel,
    Manifold,
    add_conductance_index,
    judge_conductance,
    learn_level,
    learn_manifold,
    leg_conductance,
)
from hdt_core.records.keys import LEG

FLIGHTS = 40
EACH = 8


def fly_legs(seed: int = 0) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Forty legs of eight samples whose outlet follows a law of the operating point, with a few strays."""
    rng = np.random.default_rng(seed)
    n = FLIGHTS * EACH
    ranges = {
        "pack_flow_kg_s": (0.6, 0.9), "ram_door_open": (0.15, 0.7), "mach": (0.7, 0.86), "tat_k": (240.0, 265.0),
        "total_pressure_pa": (28e3, 42e3),
    }  # fmt: skip
    s = {name: rng.uniform(*limits, n) for name, limits in ranges.items()}
    wear = np.repeat(0.002 * np.arange(FLIGHTS), EACH)
    y = 0.9 - 0.6 * np.log(s["pack_flow_kg_s"] / 0.75) + 0.4 * np.log(s["ram_door_open"] / 0.4)
    y = y - wear + rng.standard_t(3, n) * 0.02
    out = (400.0 + np.exp(y) * s["tat_k"]) / (1.0 + np.exp(y))
    key = {"operator": "TST", "tail": "T", "flight_id": np.repeat([f"F{k:02d}" for k in range(FLIGHTS)], EACH)}
    other = {"source": "acms", "cc_flow_kg_s": 0.8}
    signals = key | {"pack": 1, "monitored": True, "hx_in_k": 400.0, "hx_out_k": out} | other | s
    samples = pl.DataFrame(signals).cast({"pack": pl.Int32})
    legs = samples.select(LEG).unique(maintain_order=True).with_columns(flight_number=pl.int_range(pl.len()))
    return samples, legs


def ratio_ln(samples: pl.DataFrame) -> np.ndarray:
    hot, out, tat = (samples[name].to_numpy() for name in ("hx_in_k", "hx_out_k", "tat_k"))
    return np.log((hot - out) / (out - tat))


def terms(samples: pl.DataFrame) -> np.ndarray:
    s = {name: samples[name].to_numpy() for name in samples.columns}
    flow = np.log(s["pack_flow_kg_s"])
    door = np.log(np.maximum(s["ram_door_open"], 0.02))
    density = np.log(s["total_pressure_pa"] / np.sqrt(s["tat_k"])) - 7.7
    speed = np.log(np.maximum(s["mach"], 0.2))
    return np.column_stack([flow, door, density, speed, door**2, door * density, flow * door])


@pytest.fixture(scope="module")
def slopes() -> np.ndarray:
    """Of Huber's regression with an offset for every ten flights."""
    samples, _ = fly_legs()
    rows = np.column_stack([terms(samples), ratio_ln(samples)])
    block = np.repeat(np.arange(FLIGHTS) // 10, EACH)
    off = np.concatenate([rows[block == b] - np.median(rows[block == b], axis=0) for b in range(4)])
    weight = np.ones(len(rows))
    for _ in range(12):
        normal = off[:, :7].T @ (weight[:, None] * off[:, :7]) + 1e-6 * len(rows) * np.eye(7)
        slopes = np.linalg.solve(normal, off[:, :7].T @ (weight * off[:, 7]))
        miss = np.abs(off[:, 7] - off[:, :7] @ slopes)
        weight = np.minimum(1.0, 1.345 * 1.4826 * np.median(miss) / np.maximum(miss, 1e-12))
    return slopes


def test_manifold_is_huber_regression(slopes):
    samples, legs = fly_legs()
    law = learn_manifold(samples, legs)
    assert law.centre == pytest.approx(np.median(terms(samples), axis=0).tolist())
    assert law.slopes == pytest.approx(slopes.tolist(), rel=1e-6)


def test_index_is_ratio_off_manifold(slopes):
    samples, legs = fly_legs()
    law = learn_manifold(samples, legs)
    x = terms(samples)
    index = ratio_ln(samples) - (x - np.median(x, axis=0)) @ slopes
    steps = np.diff(index.reshape(FLIGHTS, EACH), axis=1)
    assert law.noise == pytest.approx(1.4826 * np.median(np.abs(steps)) / np.sqrt(2.0), rel=1e-6)
    assert add_conductance_index(samples, law)["conductance_index"].to_numpy() == pytest.approx(index)


LAW = Manifold((0.0,) * len(TERMS), (0.0,) * len(TERMS), 0.02)
"""The index is the ratio's logarithm itself."""


@pytest.mark.parametrize(("n", "is_learned"), [(70, False), (71, True)])
def test_manifold_needs_ten_samples_per_term(n, is_learned):
    samples, legs = fly_legs()
    assert (learn_manifold(samples.head(n), legs) is not None) is is_learned


def test_calm_record_has_least_noise():
    samples, legs = fly_legs()
    calm = samples.with_columns(hx_out_k=pl.lit(300.0), tat_k=pl.lit(250.0))
    assert learn_manifold(calm, legs).noise == 0.01


def index_of(law: Manifold = LAW, **changed: object) -> float | None:
    """Index of one sample whose streams differ by 150 K."""
    sample = fly_legs()[0].head(1).with_columns(hx_in_k=pl.lit(400.0), tat_k=pl.lit(250.0))
    return add_conductance_index(sample.with_columns(**changed), law)["conductance_index"][0]


@pytest.mark.parametrize(("out", "is_valid"), [(394.9, True), (395.0, False), (255.1, True), (255.0, False)])
def test_index_needs_five_kelvin(out, is_valid):
    expected = pytest.approx(np.log((400.0 - out) / (out - 250.0))) if is_valid else None
    assert index_of(hx_out_k=out) == expected


def test_unmonitored_sample_has_no_index():
    assert index_of(hx_out_k=255.1, monitored=False) is None


@pytest.mark.parametrize(("term", "least"), [(1, 0.02), (3, 0.2)], ids=["door", "speed"])
def test_small_readings_are_bounded(term, least):
    low = {"ram_door_open": 0.001, "mach": 0.1}
    along = Manifold((0.0,) * 7, tuple(float(k == term) for k in range(7)), 0.02)
    assert index_of(along, **low) == pytest.approx(index_of(**low) - np.log(least))


def test_unrest_is_largest_running_mean():
    """In standard errors, over two to six samples."""
    samples = fly_legs(3)[0].head(2 * EACH)
    result = leg_conductance(samples, LAW).sort("flight_id")
    index = ratio_ln(samples).reshape(2, EACH)
    level = np.median(index, axis=1)
    unrest = [
        max(abs(off[i : i + m].mean()) * np.sqrt(m) for m in (2, 3, 4, 6) for i in range(EACH - m + 1)) / 0.02
        for off in index - level[:, None]
    ]
    assert result["index_level"].to_list() == pytest.approx(level.tolist())
    assert result["index_n"].to_list() == [EACH] * 2
    assert result["index_unrest"].to_list() == pytest.approx(unrest)


@pytest.fixture
def nine_apart(monkeypatch) -> pl.DataFrame:
    """A leg of which nine samples in a row lie 0.1 above the others, its flow 0.7 and 0.8 kg/s in turn."""
    index = np.zeros(40)
    index[20:29] = 0.1
    key = {"operator": "TST", "tail": "T", "flight_id": "F", "pack": 1, "source": "acms", "cc_flow_kg_s": 0.8}
    monkeypatch.setattr(conductance_index, "add_conductance_index", lambda samples, _: samples)
    return pl.DataFrame(key | {"pack_flow_kg_s": [0.7, 0.8] * 20, "conductance_index": index})


def test_unrest_spans_nine_samples(nine_apart):
    unrest = leg_conductance(nine_apart, LAW)["index_unrest"]
    assert unrest.to_list() == pytest.approx([0.1 * 3.0 / 0.02])  # sqrt(9) = 3


def test_step_of_flow_is_no_unrest(nine_apart):
    """One step of 0.1 kg/s in 0.75 moves the index by 0.08, door at the law's centre."""
    law = Manifold((0.0, -1.0, *[0.0] * 5), (-0.4, *[0.0] * 5, 0.2), 0.02)
    leg = leg_conductance(nine_apart, law).row(0, named=True)
    assert leg["index_step"] == pytest.approx(0.08)
    assert leg["index_unrest"] == pytest.approx((0.1 - 0.08) * 3.0 / 0.02)


N = 50
FLIGHT = np.arange(N)


def levels(level: np.ndarray, unrest: float = 0.0) -> pl.DataFrame:
    flights = [f"F{k:02d}" for k in range(N)]
    key = {"operator": "TST", "tail": "T", "flight_id": flights, "pack": 1, "flight_number": FLIGHT}
    rows = pl.DataFrame(key | {"index_level": level, "index_unrest": unrest, "index_n": 8, "index_step": 0.0}).cast(
        {"pack": pl.Int32}
    )
    days = pl.duration(days=pl.col("flight_number"))
    return rows.with_columns(departed_at=pl.datetime(2024, 3, 1, time_zone="UTC") + days)


UNKNOWN = IndexLevel()


def judge_levels(level: np.ndarray, fleet: IndexLevel = UNKNOWN, **more: float) -> pl.DataFrame:
    rows = judge_conductance(levels(level, **more), NO_LOG, fleet)
    return rows.sort(LEG)


@pytest.mark.parametrize(("drop", "worn"), [(0.091, True), (0.089, False)])
def test_worn_is_below_clean_level(drop, worn):
    rows = judge_levels(np.where(FLIGHT < 20, 1.0, 1.0 - drop))
    assert rows["worn"].to_list() == ((FLIGHT >= 20) & worn).tolist()


@pytest.mark.parametrize(("above", "n_worn"), [(6, N - 6), (4, 0)])
def test_clean_level_is_upper_decile(above, n_worn):
    """Of fifty flights so many lie above it."""
    assert judge_levels(np.where(above > FLIGHT, 1.2, 1.0))["worn"].sum() == n_worn


@pytest.mark.parametrize(("level", "worn"), [(0.809, True), (0.811, False)])
def test_clean_level_is_near_fleets(level, worn):
    """No lower than the fleet's less two deviations."""
    assert judge_levels(np.full(N, level), IndexLevel(clean=1.0))["worn"].to_list() == [worn] * N


@pytest.mark.parametrize(("off", "stray"), [(0.091, True), (0.089, False)])
def test_rounding_of_flow_is_no_stray(off, stray):
    """Half a step of 0.04 beyond the limit of 0.07."""
    rows = levels(np.where(FLIGHT == 25, off, 0.0)).with_columns(index_step=pl.lit(0.04))
    assert judge_conductance(rows, NO_LOG, UNKNOWN)["stray"].any() == stray


@pytest.mark.parametrize(("unrest", "restless"), [(6.51, True), (6.5, False)])
def test_unrest_limit(unrest, restless):
    assert judge_levels(np.full(N, 1.0), unrest=unrest)["unrest"].to_list() == [restless] * N


@pytest.mark.parametrize(
    ("off", "usual", "stray"),
    [
        (0.071, 0.0, True), (0.069, 0.0, False), (-0.071, 0.0, True), (4.51 * 1.4826 * 0.02, 0.02, True),
        (4.49 * 1.4826 * 0.02, 0.02, False),
    ],
)  # fmt: skip
def test_stray_leaves_neighbours(off, usual, stray):
    rows = judge_levels(1.0 + off * (FLIGHT == 25), IndexLevel(stray=usual))
    assert rows["stray"].to_list() == ((FLIGHT == 25) & stray).tolist()
    assert rows["index_off"][25] == pytest.approx(off)


@pytest.fixture(scope="module")
def level() -> np.ndarray:
    return np.random.default_rng(1).normal(1.0, 0.02, N)


@pytest.fixture(scope="module")
def smooth(level) -> np.ndarray:
    """Medians of seven flights."""
    return np.array([np.median(level[max(0, k - 3) : k + 4]) for k in FLIGHT])


def test_stray_is_off_running_median(level, smooth):
    assert judge_levels(level)["index_off"].to_list() == pytest.approx((level - smooth).tolist())


def test_lone_flight_is_no_stray(level):
    lone = judge_conductance(levels(level).head(1), NO_LOG, UNKNOWN)
    assert lone["index_off"].to_list() == [None]


def test_fleet_level_is_learned(level, smooth):
    learned = learn_level(levels(level), NO_LOG)
    assert learned.stray == pytest.approx(np.median(np.abs(level - smooth)))
    assert learned.clean == pytest.approx(np.sort(smooth)[round(0.9 * (N - 1))])


def test_no_flights_have_unknown_level(level):
    assert learn_level(levels(level).clear(), NO_LOG) == IndexLevel()


def test_outliers_exceed_chi_square_quantile():
    edge = np.sqrt(chi2.ppf(0.9995, 2))
    scatter = Scatter(("a", "b"), (1.0, 0.0), ((4.0, 0.0), (0.0, 1.0)))
    a = [1.0 + 0.5 * 1.001 * edge, 1.0 + 0.5 * 0.999 * edge, 1.0]
    rows = pl.DataFrame({"a": a, "b": [0.0, None, 1.001 * edge]})
    assert scatter.flag_outliers(rows).to_list() == [True, False, True]


@pytest.fixture(scope="module")
def residuals() -> pl.DataFrame:
    """Of four hundred legs, one of which hardly moves."""
    a = np.random.default_rng(0).normal(2.0, 0.1, 400)
    return pl.DataFrame({"a": a, "b": np.where(np.arange(400) < 201, 0.0, 1.0)})


def test_scatter_is_of_moving_residuals(residuals):
    learned = learn_scatter(residuals, ["a", "b"])
    assert learned.columns == ("a",)
    assert learned.mean[0] == pytest.approx(2.0, abs=0.03)
    assert learned.precision[0][0] == pytest.approx(100.0, rel=0.25)


@pytest.mark.parametrize(("n_still", "columns"), [(199, ("a", "b")), (200, ("a",))])
def test_moving_residual_is_mostly_nonzero(residuals, n_still, columns):
    """Zero on fewer than half of the legs."""
    b = np.where(np.arange(400) < n_still, 0.0, np.random.default_rng(1).normal(size=400))
    assert learn_scatter(residuals.with_columns(b=pl.Series(b)), ["a", "b"]).columns == columns


def test_residual_with_gaps_is_left_out(residuals):
    gaps = residuals.with_columns(b=pl.when(pl.col("b") > 0.0).then("a"))
    assert learn_scatter(gaps, ["a", "b"]).columns == ("a",)


@pytest.mark.parametrize(("n", "is_learned"), [(0, False), (199, False), (200, True)])
def test_scatter_needs_200_legs(residuals, n, is_learned):
    assert (learn_scatter(residuals.head(n), ["a"]) is not None) is is_learned
