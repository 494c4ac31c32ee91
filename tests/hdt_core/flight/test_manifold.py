"""The conductance index by hand, its slopes; wear, unrest and strays at their edges; distance from a nominal fleet."""

import numpy as np
import polars as pl
import pytest
from scipy.stats import chi2

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

FLIGHTS, EACH = 40, 8


def flown(seed: int = 0) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Forty legs of eight samples whose outlet follows a law of the operating point, with a few strays."""
    rng, n = np.random.default_rng(seed), FLIGHTS * EACH
    flow, door, mach = rng.uniform(0.6, 0.9, n), rng.uniform(0.15, 0.7, n), rng.uniform(0.7, 0.86, n)
    tat, total = rng.uniform(240.0, 265.0, n), rng.uniform(28e3, 42e3, n)
    wear = np.repeat(0.002 * np.arange(FLIGHTS), EACH)
    y = 0.9 - 0.6 * np.log(flow / 0.75) + 0.4 * np.log(door / 0.4) - wear + rng.standard_t(3, n) * 0.02
    hot = np.full(n, 400.0)
    out = (hot + np.exp(y) * tat) / (1.0 + np.exp(y))
    flights = np.repeat([f"F{k:02d}" for k in range(FLIGHTS)], EACH)
    key = {"operator": "TST", "tail": "T", "flight_id": flights, "pack": 1}
    signals = {
        "monitored": True, "hx_in_k": hot, "hx_out_k": out, "tat_k": tat, "pack_flow_kg_s": flow, "ram_door_open": door,
        "total_pressure_pa": total, "mach": mach,
    }  # fmt: skip
    samples = pl.DataFrame(key | signals).cast({"pack": pl.Int32})
    legs = samples.select(LEG).unique(maintain_order=True).with_columns(flight_number=pl.int_range(pl.len()))
    return samples, legs


def terms(s: dict[str, np.ndarray]) -> np.ndarray:
    flow, door = np.log(s["pack_flow_kg_s"]), np.log(np.maximum(s["ram_door_open"], 0.02))
    density = np.log(s["total_pressure_pa"] / np.sqrt(s["tat_k"])) - 7.7
    speed = np.log(np.maximum(s["mach"], 0.2))
    return np.column_stack([flow, door, density, speed, door**2, door * density, flow * door])


def columns(samples: pl.DataFrame) -> dict[str, np.ndarray]:
    return {name: samples[name].to_numpy() for name in samples.columns}


def test_manifold_is_huber_regression():
    """With an offset for every ten flights."""
    samples, legs = flown()
    s = columns(samples)
    x = terms(s)
    y = np.log((s["hx_in_k"] - s["hx_out_k"]) / (s["hx_out_k"] - s["tat_k"]))
    block = np.repeat(np.arange(FLIGHTS) // 10, EACH)
    centred = [np.column_stack([x, y])[block == b] for b in range(4)]
    off = np.concatenate([rows - np.median(rows, axis=0) for rows in centred])
    slopes, weight = np.zeros(7), np.ones(len(y))
    for _ in range(12):
        normal = off[:, :7].T @ (weight[:, None] * off[:, :7]) + 1e-6 * len(y) * np.eye(7)
        slopes = np.linalg.solve(normal, off[:, :7].T @ (weight * off[:, 7]))
        miss = np.abs(off[:, 7] - off[:, :7] @ slopes)
        weight = np.minimum(1.0, 1.345 * 1.4826 * np.median(miss) / np.maximum(miss, 1e-12))
    law = learn_manifold(samples, legs)
    assert law.centre == pytest.approx(np.median(x, axis=0).tolist())
    assert law.slopes == pytest.approx(slopes.tolist(), rel=1e-6)
    index = (y - (x - np.median(x, axis=0)) @ slopes).reshape(FLIGHTS, EACH)
    assert law.noise == pytest.approx(1.4826 * np.median(np.abs(np.diff(index, axis=1))) / np.sqrt(2.0), rel=1e-6)
    computed = add_conductance_index(samples, law)["conductance_index"].to_numpy()
    assert computed == pytest.approx(index.ravel())


def test_manifold_needs_ten_samples_per_term():
    samples, legs = flown()
    assert learn_manifold(samples.head(70), legs) is None
    assert learn_manifold(samples.head(71), legs) is not None
    calm = samples.with_columns(hx_out_k=pl.lit(300.0), tat_k=pl.lit(250.0))
    assert learn_manifold(calm, legs).noise == 0.01
    samples = flown()[0].head(1).with_columns(hx_in_k=pl.lit(400.0), tat_k=pl.lit(250.0))
    for out, is_valid in ((394.9, True), (395.0, False), (255.1, True), (255.0, False)):
        index = add_conductance_index(samples.with_columns(hx_out_k=pl.lit(out)), LAW)["conductance_index"][0]
        assert index == (pytest.approx(np.log((400.0 - out) / (out - 250.0))) if is_valid else None)
    off = samples.with_columns(monitored=pl.lit(False))
    assert add_conductance_index(off, LAW)["conductance_index"].to_list() == [None]
    low = samples.with_columns(ram_door_open=pl.lit(0.001), mach=pl.lit(0.1))
    shut, slow = (Manifold((0.0,) * 7, tuple(float(k == i) for k in range(7)), 0.02) for i in (1, 3))
    y = add_conductance_index(low, LAW)["conductance_index"][0]
    assert add_conductance_index(low, shut)["conductance_index"][0] == pytest.approx(y - np.log(0.02))
    assert add_conductance_index(low, slow)["conductance_index"][0] == pytest.approx(y - np.log(0.2))


LAW = Manifold((0.0,) * len(TERMS), (0.0,) * len(TERMS), 0.02)
"""The index is the ratio's logarithm itself."""


def test_unrest_is_largest_running_mean(monkeypatch):
    samples = flown(3)[0].head(2 * EACH)
    result = leg_conductance(samples, LAW).sort("flight_id")
    s = columns(samples)
    index = np.log((s["hx_in_k"] - s["hx_out_k"]) / (s["hx_out_k"] - s["tat_k"])).reshape(2, EACH)
    for row, own in zip(result.rows(named=True), index, strict=True):
        off = own - np.median(own)
        means = [abs(off[i : i + m].mean()) * np.sqrt(m) for m in (2, 3, 4, 6) for i in range(EACH - m + 1)]
        assert (row["index_level"], row["index_n"]) == (pytest.approx(np.median(own)), EACH)
        assert row["index_unrest"] == pytest.approx(max(means) / 0.02)
    index = np.zeros(40)
    index[20:29] = 0.1
    rows = pl.DataFrame({"operator": "TST", "tail": "T", "flight_id": "F", "pack": 1, "conductance_index": index})
    monkeypatch.setattr(conductance_index, "add_conductance_index", lambda samples, _: samples)
    law = Manifold((), (), 0.02)
    assert leg_conductance(rows, law)["index_unrest"].to_list() == pytest.approx([0.1 * 3.0 / 0.02])  # sqrt(9) = 3


N = 50
FLIGHT = np.arange(N)
TEXT = dict.fromkeys(("operator", "tail", "component", "action"), pl.String)
NO_LOG = pl.DataFrame(schema=TEXT | {"pack": pl.Int32, "done_on": pl.Date})


def levels(level: np.ndarray, unrest: float = 0.0) -> pl.DataFrame:
    flights = [f"F{k:02d}" for k in range(N)]
    key = {"operator": "TST", "tail": "T", "flight_id": flights, "pack": 1, "flight_number": FLIGHT}
    rows = pl.DataFrame(key | {"index_level": level, "index_unrest": unrest, "index_n": 8}).cast({"pack": pl.Int32})
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


def test_clean_level_is_upper_decile():
    few = np.where(FLIGHT < 6, 1.2, 1.0)  # above the decile on six flights of fifty
    assert judge_levels(few)["worn"].sum() == N - 6
    assert judge_levels(np.where(FLIGHT < 4, 1.2, 1.0))["worn"].sum() == 0
    assert judge_levels(np.full(N, 0.809), IndexLevel(clean=1.0))["worn"].all()
    assert not judge_levels(np.full(N, 0.811), IndexLevel(clean=1.0))["worn"].any()


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


def test_stray_is_off_running_median():
    level = np.random.default_rng(1).normal(1.0, 0.02, N)
    smooth = [np.median(level[max(0, k - 3) : k + 4]) for k in FLIGHT]
    assert judge_levels(level)["index_off"].to_list() == pytest.approx((level - smooth).tolist())
    learned = learn_level(levels(level), NO_LOG)
    assert learned.stray == pytest.approx(np.median(np.abs(level - smooth)))
    assert learned.clean == pytest.approx(np.sort(smooth)[round(0.9 * (N - 1))])
    assert learn_level(levels(level).clear(), NO_LOG) == IndexLevel()
    lone = judge_conductance(levels(level).head(1), NO_LOG, UNKNOWN)
    assert lone["index_off"].to_list() == [None]
    edge = np.sqrt(chi2.ppf(0.9995, 2))
    scatter = Scatter(("a", "b"), (1.0, 0.0), ((4.0, 0.0), (0.0, 1.0)))
    a = [1.0 + 0.5 * 1.001 * edge, 1.0 + 0.5 * 0.999 * edge, 1.0]
    rows = pl.DataFrame({"a": a, "b": [0.0, None, 1.001 * edge]})
    assert scatter.flag_outliers(rows).to_list() == [True, False, True]


def test_scatter_needs_200_moving_legs():
    rng = np.random.default_rng(0)
    rows = pl.DataFrame({"a": rng.normal(2.0, 0.1, 400), "b": np.where(np.arange(400) < 201, 0.0, 1.0)})
    learned = learn_scatter(rows, ["a", "b"])
    assert learned.columns == ("a",)
    assert learned.mean[0] == pytest.approx(2.0, abs=0.03)
    assert learned.precision[0][0] == pytest.approx(100.0, rel=0.25)
    moving = rows.with_columns(b=pl.Series(np.where(np.arange(400) < 199, 0.0, rng.normal(size=400))))
    assert learn_scatter(moving, ["a", "b"]).columns == ("a", "b")
    half = rows.with_columns(b=pl.Series(np.where(np.arange(400) < 200, 0.0, rng.normal(size=400))))
    assert learn_scatter(half, ["a", "b"]).columns == ("a",)
    gaps = rows.with_columns(b=pl.when(pl.col("b") > 0.0).then("a"))
    assert learn_scatter(gaps, ["a", "b"]).columns == ("a",)
    assert learn_scatter(rows.head(199), ["a"]) is None
    assert learn_scatter(rows.head(200), ["a"]) is not None
    assert learn_scatter(rows.clear(), ["a"]) is None
