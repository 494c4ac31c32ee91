"""The calibration's rules and the evidence for missing physics: levels, defaults, instruments and bars in numbers."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, flights, with_bias
from known_fleet import fleet_with_truth

from hdt_core.calibration import calibrate as calibration
from hdt_core.calibration import exchanger as hx
from hdt_core.calibration import missing_physics
from hdt_core.calibration.arrays import correct_inputs, flights_of
from hdt_core.calibration.baseline_wear import _clean_units, entry_posterior
from hdt_core.calibration.calibrate import _draft_model, _middle_flows, _select_admitted, calibrate, exchanger_levels
from hdt_core.calibration.compressor import _group_slope, fit_compressor
from hdt_core.calibration.diffuser_line import BlockRows, _thin, compare_forms, fit_line, rows_of
from hdt_core.calibration.dsm import version_of
from hdt_core.calibration.exchanger import instruments_of
from hdt_core.calibration.inlet_law import full_open_inlet_k
from hdt_core.calibration.missing_physics import _columns, _evidence, _fit, _flight_steps, _rms, _step, propose
from hdt_core.calibration.pooling import levels_of
from hdt_core.calibration.sensor_biases import probe_corrections
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.physics.terms import TERMS


@pytest.fixture(scope="module")
def small():
    return fleet_with_truth(1, 12, seed=5)


def test_empty_record_keeps_priors(small):
    """The level of clean units to 5 %, theirs to 5.5, a flight to 2 %; the law's reference flows and conductance."""
    draft = _draft_model(small.samples.clear(), small.legs.clear(), {})
    assert (draft.clean_level, draft.clean_level_sd, draft.offset_sd, draft.flight_sd) == (0.0, 0.05, 0.055, 0.02)
    assert (draft.reference_ua_w_k, draft.cruise_flows_kg_s, draft.hot_inlet) == (1700.0, (0.9, 1.6), ())
    assert set(draft.gradient) == {0.0}
    np.testing.assert_allclose(np.diag(draft.exchanger_cov), hx.SD**2)
    whole = calibrate(small.samples.clear(), small.legs.clear(), small.maintenance)
    assert (whole.n_flights, whole.levels, whole.terms, whole.ram_balance_seen) == (0, (), {}, False)
    assert _clean_units(np.zeros(0), np.zeros(0), np.zeros(0, bool)) == (0.0, 0.05, pytest.approx(0.05))
    rows = small.samples.head(3).with_columns(cc_out_k=pl.Series([450.0, 450.0, None]))
    bias, pack_out_k = np.zeros((6, 3)), np.full(3, 296.0)
    np.testing.assert_array_equal(full_open_inlet_k(rows, (), DSM.design, bias, pack_out_k), rows["hx_in_k"])
    full_open = full_open_inlet_k(rows, (0.6, 0.3, 0.0, 0.0, 0.0, 0.0), DSM.design, bias, pack_out_k)
    assert full_open[2] == rows["hx_in_k"][2]
    assert (full_open[:2] != rows["hx_in_k"][:2].to_numpy()).all()


def test_draft_is_anchored_at_points(small):
    draft = _draft_model(small.samples, small.legs, {})
    assert (draft.n_flights, [p.n_flights for p in draft.packs]) == (10, [10, 10])  # the second milestone
    design, own = draft.design, small.samples.filter(pl.col("flight_id") <= "T-00_20240110_01")
    points = {n: own[n].to_numpy().astype(float) for n in (*hx.SIGNALS, "ram_out_k")}
    hot, ram = draft.cruise_flows_kg_s
    assert hot == pytest.approx(np.median(points["pack_flow_kg_s"]), rel=0.02)
    assert ram == pytest.approx(np.median(clean_ram_flow_kg_s(points, design)), rel=0.02)
    bias = draft.bias_of(own)
    both = [(design + e, design - e) for e in 1e-5 * np.eye(len(design))]
    slope = [np.subtract(*(hx.ln_conductance_ratio(points, d, bias) for d in pair)) / 2e-5 for pair in both]
    np.testing.assert_allclose(draft.gradient, np.nanmean(slope, axis=1), rtol=0.05, atol=0.02)
    assert _middle_flows([], design) == (0.9, 1.6)


@pytest.mark.parametrize(("verdicts", "n_rows"), [([True, False], 1), ([None, None], 2), ([None, False], 1)])
def test_unjudged_leg_calibrates(verdicts, n_rows):
    base = flights(2).select("operator", "tail", "pack", "flight_id")
    legs = base.with_columns(admitted=pl.Series(verdicts, dtype=pl.Boolean))
    assert _select_admitted(base, legs).height == n_rows
    assert _select_admitted(base, legs.head(1)).height == (2 if verdicts[0] is not False else 1)
    assert _select_admitted(base, legs.clear()).height == 2


def test_pack_levels_exclude_wear():
    """A pack's level is that of its first ten flights, cleared of wear."""
    ratios = {"A": -0.03, "B": 0.05, "C": -0.2}
    rows = [flights(n, tail=t, ln_ua_ratio=[v] * 10 + [9.0] * (n - 10) if n > 10 else [v] * n)
            for (t, v), n in zip(ratios.items(), (12, 10, 4), strict=True)]  # fmt: skip
    levels = exchanger_levels(pl.concat(rows), DSM)
    n = np.array([10, 10, 4])
    value, error = np.array(list(ratios.values())), 0.015 * 1.2533 / np.sqrt(n)
    entry = entry_posterior(value, error**2, 0.02, 0.05)
    frame = pl.DataFrame({"operator": "TST", "tail": list(ratios), "pack": 1, "value": value + entry.wear,
                          "error_sd": np.sqrt(error**2 + entry.wear_var), "n": n})  # fmt: skip
    pooled = levels_of(frame, "hx_ua_reference_w_k")[1]
    ln_ua = dict(zip(hx.NAMES, DSM.exchanger, strict=True))["ln_ua_reference"]
    for one, level in zip(levels, pooled, strict=True):
        ua = np.exp(ln_ua + level.value)
        assert (one.value, one.sd) == pytest.approx((ua, ua * np.hypot(level.sd, 0.1)), rel=1e-4)
        assert (one.tail, one.n_flights, one.parameter) == (level.tail, level.n_flights, "hx_ua_reference_w_k")
    assert exchanger_levels(rows[0].clear(), DSM) == ()


def test_instruments_are_logarithms():
    """Temperature, pressure, hot inlet, Mach number and flow; squares and product of the first two."""
    at = dict(tat_k=255.0, total_pressure_pa=3e4, hx_in_k=400.0, mach=0.83, pack_flow_kg_s=0.8)  # noqa: C408
    signals = {n: np.array([v * np.exp(0.1 * k), np.nan]) for k, (n, v) in enumerate(at.items(), 1)}
    np.testing.assert_allclose(instruments_of(signals), [[0.1, 0.2, 0.3, 0.4, 0.5, 0.01, 0.04, 0.02], [0.0] * 8])
    rows = pl.concat([flights(3), flights(3, pack=2)]).rename({"departed_at": "time_utc"})
    late = rows.with_columns(time_utc=pl.when(pl.col("flight_id") == "T-1_000").then(pl.col("time_utc").max())
                             .otherwise("time_utc"))  # fmt: skip
    ordered = flights_of(late)
    assert ordered.select("pack", "flight_id", "order").rows() == [
        (pack, flight, order) for pack in (1, 2) for order, flight in enumerate(("T-1_001", "T-1_000", "T-1_002"))
    ]
    logged = late.with_columns(departed_at=pl.lit(late["time_utc"].min()))
    assert set(flights_of(logged)["departed_at"]) == {late["time_utc"].min()}
    assert correct_inputs(late, {}) is late
    frame = pl.DataFrame({"a": [1.0, 2.0], "b": ["x", "y"]})
    assert version_of(frame) == version_of(frame.with_columns(pl.col("a") + 1e-12))
    assert len({version_of(f) for f in (frame, frame.with_columns(pl.col("a") + 1e-9), frame.rename({"a": "c"}),
                                        frame.cast({"a": pl.Int64}), frame.reverse())}) == 5  # fmt: skip
    assert len(version_of(frame)) == 12


def machines(n_flights: int, seed: int = 1) -> BlockRows:
    rng = np.random.default_rng(seed)
    flight = np.repeat(np.arange(n_flights), 4)
    x = rng.uniform(300.0, 500.0, flight.size)
    y = 0.17 - 2e-5 * (x - 400.0) + 0.002 * rng.standard_normal(flight.size)
    blocks = pl.DataFrame({"operator": "O", "tail": "A", "pack": 1, "turn": [0]})
    return BlockRows(x, y, np.zeros(flight.size, int), flight, blocks)


def test_share_interval_resamples_flights():
    rows = machines(30)
    linear = compare_forms(rows)[1]
    slope, level = np.polyfit(rows.x, rows.y, 1)
    rest, about = rows.y - level - slope * rows.x, rows.y - rows.y.mean()
    picks = np.random.default_rng(0).multinomial(30, np.full(30, 1 / 30), 200)
    share = 1.0 - (picks @ np.bincount(rows.flight, rest**2)) / (picks @ np.bincount(rows.flight, about**2))
    np.testing.assert_allclose(np.quantile(share, [0.025, 0.975]), (linear.r_squared_low, linear.r_squared_high))


@pytest.mark.parametrize(("samples", "n_samples"), [(119_996, 119_996), (120_000, 60_000)])
def test_thinning_takes_whole_flights(samples, n_samples):
    """Evenly over the record."""
    flight = np.arange(samples) // 4
    blocks = pl.DataFrame({"turn": range(samples // 4)})
    few = _thin(BlockRows(np.arange(samples), np.arange(samples), flight, flight, blocks))
    assert len(few.x) == n_samples
    assert few.flight.tolist() == few.block.tolist() == (np.arange(n_samples) // 4).tolist()
    assert few.x[4] == 4 * samples // n_samples
    assert len(few.blocks) == n_samples // 4


def compressor(n: int, **columns) -> pl.DataFrame:
    rng = np.random.default_rng(4)
    named = {"operator": "O", "tail": "A", "pack": 1, "time_utc": range(n), "vda_counts": rng.uniform(300, 500, n),
             "flight_id": [f"F{k:03d}" for k in range(n)], "diameter_m": 0.17, "efficiency": 0.8,
             "group_m3": 9e-4 + 1e-6 * rng.standard_normal(n)}  # fmt: skip
    return pl.DataFrame(named | columns)


def test_group_slope_needs_thirty_points():
    rows = compressor(30)
    line = fit_line(rows_of(rows, "group_m3"))
    assert _group_slope(rows) == (line.slope, line.slope_sd)
    assert _group_slope(compressor(29)) == (0.0, 0.0)
    prior = fit_compressor(compressor(29))
    assert (prior.scatter_m, prior.mae_m, prior.r_squared, prior.vda_counts) == (0.0055, 0.0055, 0.0, 400.0)
    assert (prior.group_slope_m3_per_count, prior.group_slope_sd_m3_per_count, prior.vda_widest_counts) == (0, 0, 0)
    assert (prior.intercept_sd_m, prior.forms, prior.levels) == (pytest.approx(0.02, abs=0.015), (), ())
    alone = compressor(40, flight_id="F")
    assert fit_compressor(alone).scatter_m == 0.0055  # one flight of one pack
    pair = compressor(40, flight_id=["F"] * 20 + ["G"] * 20, diameter_m=0.17 + 1e-3 * np.sin(np.arange(40.0)))
    fit = fit_compressor(pair)
    line = fit_line(rows_of(pair, "diameter_m"))
    assert (fit.mae_m, fit.r_squared) == (pytest.approx(np.abs(line.residual).mean()), 0.0)


@pytest.mark.parametrize(
    ("packs", "n", "size", "share"),
    [(3, 60, 1.0, 0.0), (4, 80, 1.0, 0.8), (4, 39, 1.0, 0.0), (4, 40, 1.0, 0.8), (4, 80, 9.0, None)],
)
def test_exit_correction_needs_four_packs(packs, n, size, share):
    """A cubic of height and the logarithm of flow, the fleet's; each pack flies at heights of its own. A probe is
    declared to 0.4 %: its share is that variance over the packs'."""
    rng, beyond = np.random.default_rng(1), size * np.array([0.001, 0.0, -0.001, 0.002])[:packs]
    height, flow, pack = rng.uniform(0.8, 1.2, n), rng.uniform(0.7, 1.1, n), np.arange(n) % packs
    out = 11.0 + height - 0.3 * height**2 + 0.1 * height**3 + 0.5 * np.log(flow) + beyond[pack]
    frame = pl.DataFrame(
        {
            "tail": [f"T{p}" for p in pack],
            "flight_id": [f"F{k}" for k in range(n)],
            "altitude_m": 1e4 * height,
            "cc_flow_kg_s": flow,
            "pack_flow_kg_s": flow,
            "cc_out_pa": np.exp(out),
        }
    )
    sound = {"operator": "O", "pack": 1, "cc_in_k": 250.0, "tat_k": 250.0, "cc_in_pa": 3e4, "total_pressure_pa": 3e4}
    frame = frame.with_columns(pl.lit(v).alias(c) for c, v in sound.items())
    columns = np.column_stack([height**k for k in range(4)] + [np.log(flow)])
    left = out - columns @ np.linalg.lstsq(columns, out)[0]
    offsets = np.array([np.median(left[pack == p]) for p in range(packs)])
    packs = frame.select("operator", "tail", "pack").unique().sort("tail")
    corrections = probe_corrections(frame, packs)["exit_bias_ln"]
    share = 0.004**2 / (np.sum((offsets - offsets.mean()) ** 2) / 3.0) if share is None else share
    assert share < 0.81
    np.testing.assert_allclose(corrections, share * (offsets - np.median(offsets)), atol=1e-9)
    assert np.ptp(offsets) > 0.001


def test_inlet_difference_is_shared_by_error():
    """Of 1 and 0.5 K, 0.3 and 0.2 %. A probe without a reading, or with a pressure below 0, has no error to correct."""
    packs = pl.DataFrame({"operator": "O", "tail": list("ABCDE"), "pack": 1})
    nothing = dict.fromkeys(("altitude_m", "cc_flow_kg_s", "pack_flow_kg_s", "cc_out_pa"), 1.0)
    rows = packs.with_columns(
        flight_id=pl.lit("F"), tat_k=pl.lit(250.0), cc_in_k=pl.Series([251.0, 253.0, 257.0, 253.0, None]),
        total_pressure_pa=pl.lit(3e4), cc_in_pa=pl.Series([3e4, 2.7e4, 2.5e4, -3e4, None]),
        **{c: pl.lit(v) for c, v in nothing.items()},
    )  # fmt: skip
    corrections = probe_corrections(rows, packs)
    np.testing.assert_allclose(corrections["inlet_bias_k"], np.array([-2.0, 0.0, 4.0, 0.0, 0.0]) * 0.8)
    ratio = np.log([1.0, 0.9, 2.5 / 3.0])
    middle = 0.5 * (ratio[0] + ratio[1])  # NaN is above all
    np.testing.assert_allclose(corrections["inlet_bias_ln"], [*((ratio - middle) * 9.0 / 13.0), 0.0, 0.0])
    assert corrections["exit_bias_ln"].to_list() == [0.0] * 5


# value, sd, BIC's gain, held-out change
BARS = (0.41, 0.1, 6.1, -0.11)


@pytest.mark.parametrize(
    ("at", "value", "proposed"),
    [(None, 0.0, True), (0, 0.39, False), (0, -0.41, True), (2, 5.9, False), (3, -0.09, False), (3, 0.11, False)],
)
def test_term_is_proposed_over_bars(monkeypatch, at, value, proposed):
    """Six of BIC, a tenth of the residuals, four deviations, off its bounds; and it is the best."""
    numbers = [value if k == at else bar for k, bar in enumerate(BARS)]
    best, second = list(TERMS)[:2]

    def row(_steps, _dsm, name):
        v, sd, bic, held_out = numbers if name == best else (0.9, 0.1, numbers[2] - 0.1, -0.5)
        return (name, "", v, sd, "-", bic, 20.0, held_out, 0.1, 99)

    monkeypatch.setattr(missing_physics, "_evidence", row)
    monkeypatch.setattr(missing_physics, "_flight_steps", lambda *_: type("S", (), {"fold": np.zeros(60)}))
    monkeypatch.setattr(missing_physics, "TERMS", {n: replace(TERMS[n], bounds=(-9.0, 9.0)) for n in (best, second)})
    proposals = propose(pl.DataFrame(), DSM)
    assert proposals["term"].to_list() == [best, second]
    assert proposals["proposed"].to_list() == [proposed, False]
    bound = (numbers[0], 9.0)
    monkeypatch.setattr(missing_physics, "TERMS", {n: replace(TERMS[n], bounds=bound) for n in (best, second)})
    assert not propose(pl.DataFrame(), DSM)["proposed"].any()
    others = propose(pl.DataFrame(), replace(DSM, terms={best: 0.1}))
    assert others["term"].to_list() == [second]
    monkeypatch.setattr(missing_physics, "_flight_steps", lambda *_: type("S", (), {"fold": np.zeros(59)}))
    assert propose(pl.DataFrame(), DSM).select("value", "n").rows() == [(None, 59)] * 2


def test_step_is_huber_regression():
    """The design under its prior, the term under none; of neighbouring changes ten count as one."""
    rng, p = np.random.default_rng(2), len(hx.MEAN)
    instruments = rng.standard_normal((80, 8))
    columns = instruments @ rng.standard_normal((8, p + 1)) + 0.3 * rng.standard_normal((80, p + 1))
    left = columns[:, 0] * 0.5 + 0.1 * rng.standard_normal(80)
    left[::16] += 3.0
    design = hx.MEAN + 0.1 * hx.SD
    z = instruments @ np.linalg.pinv(instruments) @ columns
    weight, scale = np.ones(80), 1.4826 * np.median(np.abs(left))
    for _ in range(10):
        normal = (z * weight[:, None]).T @ z / (10.0 * scale**2) + np.diag(np.r_[0.0, hx.SD**-2.0])
        right = (z * weight[:, None]).T @ left / (10.0 * scale**2) + np.r_[0.0, (hx.MEAN - design) / hx.SD**2]
        step = np.linalg.solve(normal, right)
        away = left - columns @ step
        scale = 1.4826 * np.median(np.abs(away))
        weight = np.minimum(1.0, 2.0 * scale / np.abs(away))
    estimate, sd = _step(columns, left, instruments, design)
    np.testing.assert_allclose(estimate, step, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(sd, np.sqrt(np.diag(np.linalg.inv(normal))), rtol=1e-6)
    assert _rms(np.array([1.0, -9.0, np.nan]), 2.0) == pytest.approx(np.sqrt(2.5))


def cruise_of(n: int, tail: str, seed: int, pack: int = 1) -> pl.DataFrame:
    rng = np.random.default_rng(seed)
    ranges = {"altitude_m": (10e3, 12e3), "mach": (0.78, 0.86), "tat_k": (238.0, 262.0), "hx_in_k": (380.0, 420.0),
              "ram_door_open": (0.2, 0.6), "pack_flow_kg_s": (0.6, 0.9), "total_pressure_pa": (3e4, 4e4),
              "hx_out_k": (290.0, 300.0), "ram_out_k": (330.0, 331.0)}  # fmt: skip
    return flights(n, tail=tail, pack=pack, ln_ua_ratio=list(rng.normal(0.0, 0.1, n)),
                   **{name: list(rng.uniform(*limits, n)) for name, limits in ranges.items()})  # fmt: skip


def test_steps_stay_within_pack():
    """Changes are of one pack, folds are of whole aircraft."""
    rows = pl.concat([cruise_of(30, t, k) for k, t in enumerate("ABCDEFG")] + [cruise_of(9, "A", 9, pack=2)])
    gap = rows.with_columns(pl.when(pl.col("flight_id") == "B_004").then(None).otherwise("hx_in_k").alias("hx_in_k"))
    dsm = with_bias(("B", 1), hx_out_k=0.5)
    steps = _flight_steps(gap, dsm)
    assert np.bincount(steps.fold).tolist() == [29, 29 + 8 + 29, 28 + 29, 29, 29]
    ordered = gap.drop_nulls("hx_in_k").sort("operator", "tail", "pack", "departed_at")
    signals = {n: ordered[n].to_numpy() for n in hx.SIGNALS}
    here = hx.ln_conductance_ratio(signals, dsm.design, dsm.bias_of(ordered))
    np.testing.assert_allclose(steps.offset, ordered["ln_ua_ratio"].to_numpy() - here)
    own = np.diff(ordered["ln_ua_ratio"].to_numpy())[steps.change]
    np.testing.assert_allclose(steps.residual({}, dsm.design), own)
    two = _flight_steps(rows.filter(pl.col("tail").is_in(["A", "C"])), dsm)  # of two aircraft: fifths of the flights
    assert len(np.unique(two.fold)) == 5


def test_large_fleet_is_thinned_by_aircraft(monkeypatch):
    rows = pl.concat([cruise_of(10, t, k) for k, t in enumerate("ABCD")])
    for most, tails in ((40, 4), (39, 2), (20, 2), (19, 2), (13, 1)):
        monkeypatch.setattr(missing_physics, "MOST_FLIGHTS", most)
        assert _flight_steps(rows, DSM).change.sum() == tails * 9
    monkeypatch.undo()
    assert missing_physics.MOST_FLIGHTS == 20_000


def test_term_is_fitted_in_five_steps(monkeypatch):
    """A step moves a term within its bounds, and the design by half at most."""
    steps, (name, other) = _flight_steps(cruise_of(30, "A", 1), DSM), list(TERMS)[:2]
    size, p = 0.02 * TERMS[name].bounds[1], len(hx.MEAN)
    monkeypatch.setattr(missing_physics, "_step", lambda *_: (np.r_[size, np.full(p, 9.0)], np.arange(1.0, p + 2)))
    fit = _fit(steps, DSM, (name,))
    assert (fit.terms[name], fit.sd.tolist()) == (pytest.approx(5 * size), [1.0])
    np.testing.assert_allclose(fit.design, np.minimum(hx.MEAN + 2.5, hx.HIGH))
    rounds: list = []
    monkeypatch.setattr(
        calibration, "_calibrate", lambda *args: (rounds.append(args[-1]), replace(DSM, terms=args[-1]))[1]
    )
    monkeypatch.setattr(calibration, "estimate_flights", lambda samples, _model: samples)
    monkeypatch.setattr(calibration, "coefficients", lambda *_: {name: size, other: 1e9})
    rows = flights(2).rename({"departed_at": "time_utc"})
    calibrate(rows, pl.DataFrame(), pl.DataFrame(), (name, other))
    assert [r[name] for r in rounds] == pytest.approx([0.0, size, 2 * size, 3 * size])
    assert [r[other] for r in rounds] == [0.0, *[TERMS[other].bounds[1]] * 3]
    rounds.clear()
    calibrate(rows, pl.DataFrame(), pl.DataFrame())
    assert rounds == [{}]


def test_evidence_matches_hand_computation():
    rows = pl.concat([cruise_of(40, t, k) for k, t in enumerate("ABC")])
    changes, name = _flight_steps(rows, DSM), next(iter(TERMS))
    fit, row = _fit(changes, DSM, (name,)), _evidence(changes, DSM, name)
    f, n = (fit.terms[name] / fit.sd[0]) ** 2, len(changes.fold)
    assert row[2:4] == pytest.approx((fit.terms[name], fit.sd[0]))
    assert (row[5], row[6], row[9]) == pytest.approx((f - np.log(n), f, n))
    before = changes.residual({}, DSM.design)
    limit = 4.0 * 1.4826 * np.median(np.abs(before))
    after = np.empty(n)
    for fold in np.unique(changes.fold):
        out = changes.fold == fold
        other = _fit(changes, DSM, (name,), ~out)
        after[out] = changes.residual(other.terms, other.design)[out]
    ratio = np.sqrt(np.mean(np.clip(after, -limit, limit) ** 2) / np.mean(np.clip(before, -limit, limit) ** 2))
    assert row[7] == pytest.approx(ratio - 1.0)
    steps = [changes.ratio({name: value}, DSM.design) for value in (0.25, 0.251)]
    slope = -np.diff(steps[1] - steps[0])[changes.change] / 1e-3
    np.testing.assert_allclose(_columns(changes, {name: 0.25}, DSM.design)[:, 0], slope, rtol=1e-8, atol=1e-12)
    shift = changes.ratio(fit.terms, fit.design) - changes.ratio({}, DSM.design)
    assert row[8] == pytest.approx(np.nanstd(shift))
