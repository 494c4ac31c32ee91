"""The calibration's rules and the evidence for missing physics: levels, defaults, instruments and bars in numbers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from alter import alter
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
from hdt_core.calibration.dsm import Dsm, version_of
from hdt_core.calibration.exchanger import instruments_of
from hdt_core.calibration.inlet_law import full_open_inlet_k
from hdt_core.calibration.missing_physics import _columns, _evidence, _fit, _flight_steps, _rms, _step, propose
from hdt_core.calibration.pooling import levels_of
from hdt_core.calibration.sensor_biases import probe_corrections
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.physics.terms import TERMS
from hdt_core.records.keys import PACK


@pytest.fixture(scope="module")
def small():
    return fleet_with_truth(1, 12, seed=5)


def test_empty_draft_keeps_priors(small):
    """The level of clean units to 5 %, theirs to 5.5, a flight to 2 %; the law's reference flows and conductance."""
    draft = _draft_model(small.samples.clear(), small.legs.clear(), {})
    values = {
        "clean_level": 0.0, "clean_level_sd": 0.05, "offset_sd": 0.055, "flight_sd": 0.02, "reference_ua_w_k": 1700.0,
        "cruise_flows_kg_s": (0.9, 1.6), "hot_inlet": (),
    }  # fmt: skip
    assert {name: getattr(draft, name) for name in values} == values
    assert set(draft.gradient) == {0.0}
    np.testing.assert_allclose(np.diag(draft.exchanger_cov), hx.SD**2)


def test_empty_record_gives_empty_model(small):
    whole = calibrate(small.samples.clear(), small.legs.clear(), small.maintenance)
    assert (whole.n_flights, whole.levels, whole.terms, whole.ram_balance_seen) == (0, (), {}, False)


def test_clean_level_without_units_is_prior():
    assert _clean_units(np.zeros(0), np.zeros(0), np.zeros(0, bool)) == (0.0, 0.05, pytest.approx(0.05))


@pytest.mark.parametrize(
    ("law", "is_recorded"), [((), [True] * 3), ((0.6, 0.3, 0.0, 0.0, 0.0, 0.0), [False, False, True])]
)
def test_inlet_without_law_is_as_recorded(small, law, is_recorded):
    """Nor has the law an answer without a discharge temperature."""
    rows = small.samples.head(3).with_columns(cc_out_k=pl.Series([450.0, 450.0, None]))
    full_open = full_open_inlet_k(rows, law, DSM.design, np.zeros((6, 3)), np.full(3, 296.0))
    assert (full_open == rows["hx_in_k"].to_numpy()).tolist() == is_recorded


@pytest.fixture(scope="module")
def draft(small) -> Dsm:
    """The model's first draft."""
    return _draft_model(small.samples, small.legs, {})


@pytest.fixture(scope="module")
def anchor(small) -> pl.DataFrame:
    """Samples up to the second milestone."""
    return small.samples.filter(pl.col("flight_id") <= "T-00_20240110_01")


@pytest.fixture(scope="module")
def points(anchor) -> dict[str, np.ndarray]:
    return {n: anchor[n].to_numpy().astype(float) for n in (*hx.SIGNALS, "ram_out_k")}


def test_draft_takes_second_milestone(draft):
    assert (draft.n_flights, [p.n_flights for p in draft.packs]) == (10, [10, 10])


def test_draft_states_middle_flows(draft, points):
    ram = clean_ram_flow_kg_s(points, draft.design)
    middle = (np.median(points["pack_flow_kg_s"]), np.median(ram))
    assert draft.cruise_flows_kg_s == pytest.approx(middle, rel=0.02)


def test_no_points_have_reference_flows(draft):
    assert _middle_flows([], draft.design) == (0.9, 1.6)


def test_draft_gradient_is_at_points(draft, anchor, points):
    bias = draft.bias_of(anchor)
    both = [(draft.design + e, draft.design - e) for e in 1e-5 * np.eye(len(draft.design))]
    slope = [np.subtract(*(hx.ln_conductance_ratio(points, d, bias) for d in pair)) / 2e-5 for pair in both]
    np.testing.assert_allclose(draft.gradient, np.nanmean(slope, axis=1), rtol=0.05, atol=0.02)


@pytest.mark.parametrize(
    ("verdicts", "n_rows"),
    [([True, False], 1), ([None, None], 2), ([None, False], 1), ([True], 2), ([None], 2), ([], 2)],
)
def test_unjudged_leg_calibrates(verdicts, n_rows):
    base = flights(2).select("operator", "tail", "pack", "flight_id")
    legs = base.head(len(verdicts)).with_columns(admitted=pl.Series(verdicts, dtype=pl.Boolean))
    assert _select_admitted(base, legs).height == n_rows


def test_pack_levels_exclude_wear():
    """A pack's level is that of its first ten flights, cleared of wear."""
    ratios = {"A": -0.03, "B": 0.05, "C": -0.2}
    rows = [flights(n, tail=t, ln_ua_ratio=[v] * 10 + [9.0] * (n - 10) if n > 10 else [v] * n)
            for (t, v), n in zip(ratios.items(), (12, 10, 4), strict=True)]  # fmt: skip
    n = np.array([10, 10, 4])
    value = np.array(list(ratios.values()))
    error = 0.015 * 1.2533 / np.sqrt(n)
    entry = entry_posterior(value, error**2, 0.02, 0.05)
    frame = pl.DataFrame({"operator": "TST", "tail": list(ratios), "pack": 1, "value": value + entry.wear,
                          "error_sd": np.sqrt(error**2 + entry.wear_var), "n": n})  # fmt: skip
    pooled = levels_of(frame, "hx_ua_reference_w_k")[1]
    ln_ua = dict(zip(hx.NAMES, DSM.exchanger, strict=True))["ln_ua_reference"]
    for one, level in zip(exchanger_levels(pl.concat(rows), DSM), pooled, strict=True):
        ua = np.exp(ln_ua + level.value)
        assert (one.value, one.sd) == pytest.approx((ua, ua * np.hypot(level.sd, 0.1)), rel=1e-4)
        assert (one.tail, one.n_flights, one.parameter) == (level.tail, level.n_flights, "hx_ua_reference_w_k")


def test_no_flights_have_no_levels():
    assert exchanger_levels(flights(0, ln_ua_ratio=0.0), DSM) == ()


def test_instruments_are_logarithms():
    """Temperature, pressure, hot inlet, Mach number and flow; squares and product of the first two."""
    at = dict(tat_k=255.0, total_pressure_pa=3e4, hx_in_k=400.0, mach=0.83, pack_flow_kg_s=0.8)  # noqa: C408
    signals = {n: np.array([v * np.exp(0.1 * k), np.nan]) for k, (n, v) in enumerate(at.items(), 1)}
    np.testing.assert_allclose(instruments_of(signals), [[0.1, 0.2, 0.3, 0.4, 0.5, 0.01, 0.04, 0.02], [0.0] * 8])


@pytest.fixture
def late_first() -> pl.DataFrame:
    """Three flights of two packs, the first of which left as the last did."""
    rows = pl.concat([flights(3), flights(3, pack=2)]).rename({"departed_at": "time_utc"})
    return alter(rows, pl.col("flight_id") == "T-1_000", time_utc=pl.col("time_utc").max())


def test_flights_are_ordered_by_departure(late_first):
    assert flights_of(late_first).select("pack", "flight_id", "order").rows() == [
        (pack, flight, order) for pack in (1, 2) for order, flight in enumerate(("T-1_001", "T-1_000", "T-1_002"))
    ]


def test_logged_departure_is_kept(late_first):
    first = late_first["time_utc"].min()
    logged = late_first.with_columns(departed_at=pl.lit(first))
    assert set(flights_of(logged)["departed_at"]) == {first}


def test_inputs_without_terms_stay(late_first):
    assert correct_inputs(late_first, {}) is late_first


VERSIONED = pl.DataFrame({"a": [1.0, 2.0], "b": ["x", "y"]})


def test_version_counts_nine_digits():
    version = version_of(VERSIONED)
    assert version == version_of(VERSIONED.with_columns(pl.col("a") + 1e-12))
    assert len(version) == 12


def test_version_follows_content():
    changed = (
        VERSIONED.with_columns(pl.col("a") + 1e-9), VERSIONED.rename({"a": "c"}), VERSIONED.cast({"a": pl.Int64}),
        VERSIONED.reverse(),
    )  # fmt: skip
    assert len({version_of(f) for f in (VERSIONED, *changed)}) == 5


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
    rest = rows.y - level - slope * rows.x
    about = rows.y - rows.y.mean()
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


def test_few_points_keep_prior_compressor():
    prior = fit_compressor(compressor(29))
    values = {
        "scatter_m": 0.0055, "mae_m": 0.0055, "r_squared": 0.0, "vda_counts": 400.0, "group_slope_m3_per_count": 0,
        "group_slope_sd_m3_per_count": 0, "vda_widest_counts": 0, "forms": (), "levels": (),
        "intercept_sd_m": pytest.approx(0.02, abs=0.015),
    }  # fmt: skip
    assert {name: getattr(prior, name) for name in values} == values


def test_one_flight_keeps_prior_scatter():
    assert fit_compressor(compressor(40, flight_id="F")).scatter_m == 0.0055


def test_two_flights_give_own_error():
    pair = compressor(40, flight_id=["F"] * 20 + ["G"] * 20, diameter_m=0.17 + 1e-3 * np.sin(np.arange(40.0)))
    fit = fit_compressor(pair)
    residual = fit_line(rows_of(pair, "diameter_m")).residual
    assert (fit.mae_m, fit.r_squared) == (pytest.approx(np.abs(residual).mean()), 0.0)


@pytest.mark.parametrize(
    ("packs", "n", "size", "share"),
    [(3, 60, 1.0, 0.0), (4, 80, 1.0, 0.8), (4, 39, 1.0, 0.0), (4, 40, 1.0, 0.8), (4, 80, 9.0, None)],
)
def test_exit_correction_needs_four_packs(packs, n, size, share):
    """A cubic of height and the logarithm of flow, the fleet's; each pack flies at heights of its own. A probe is
    declared to 0.4 %: its share is that variance over the packs', and four fifths at most."""
    rng = np.random.default_rng(1)
    beyond = size * np.array([0.001, 0.0, -0.001, 0.002])[:packs]
    height = rng.uniform(0.8, 1.2, n)
    flow = rng.uniform(0.7, 1.1, n)
    pack = np.arange(n) % packs
    out = 11.0 + height - 0.3 * height**2 + 0.1 * height**3 + 0.5 * np.log(flow) + beyond[pack]
    frame = pl.DataFrame({
        "tail": [f"T{p}" for p in pack], "flight_id": [f"F{k}" for k in range(n)], "altitude_m": 1e4 * height,
        "cc_flow_kg_s": flow, "pack_flow_kg_s": flow, "cc_out_pa": np.exp(out), "operator": "O", "pack": 1,
        "cc_in_k": 250.0, "tat_k": 250.0, "cc_in_pa": 3e4, "total_pressure_pa": 3e4,
    })  # fmt: skip
    columns = np.column_stack([height**k for k in range(4)] + [np.log(flow)])
    left = out - columns @ np.linalg.lstsq(columns, out)[0]
    offsets = np.array([np.median(left[pack == p]) for p in range(packs)])
    corrections = probe_corrections(frame, frame.select(PACK).unique().sort("tail"))["exit_bias_ln"]
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


BEST, SECOND = list(TERMS)[:2]


@pytest.fixture
def propose_by(monkeypatch) -> Callable[..., pl.DataFrame]:
    """Proposals where the first term has this evidence and the second hardly less, of so many changes."""

    def propose_terms(evidence, low: float = -9.0, changes: int = 60, dsm: Dsm = DSM) -> pl.DataFrame:
        def row(_steps, _dsm, name):
            v, sd, bic, held_out = evidence if name == BEST else (0.9, 0.1, evidence[2] - 0.1, -0.5)
            return (name, "", v, sd, "-", bic, 20.0, held_out, 0.1, 99)

        monkeypatch.setattr(missing_physics, "_evidence", row)
        monkeypatch.setattr(missing_physics, "_flight_steps", lambda *_: type("S", (), {"fold": np.zeros(changes)}))
        monkeypatch.setattr(missing_physics, "TERMS", {n: replace(TERMS[n], bounds=(low, 9.0)) for n in (BEST, SECOND)})
        return propose(pl.DataFrame(), dsm)

    return propose_terms


EVIDENCE = pytest.mark.parametrize(
    ("at", "value", "proposed"),
    [(None, 0.0, True), (0, 0.39, False), (0, -0.41, True), (2, 5.9, False), (3, -0.09, False), (3, 0.11, False)],
)


def evidence_beside(at: int | None, value: float) -> list[float]:
    return [value if k == at else bar for k, bar in enumerate(BARS)]


@EVIDENCE
def test_term_is_proposed_over_bars(propose_by, at, value, proposed):
    """Six of BIC, a tenth of the residuals, four deviations; and it is the best."""
    proposals = propose_by(evidence_beside(at, value))
    assert proposals.select("term", "proposed").rows() == [(BEST, proposed), (SECOND, False)]


@EVIDENCE
def test_term_at_bound_is_not_proposed(propose_by, at, value, proposed):
    evidence = evidence_beside(at, value)
    assert not propose_by(evidence, low=evidence[0])["proposed"].any()


def test_accepted_term_is_not_proposed(propose_by):
    assert propose_by(BARS, dsm=replace(DSM, terms={BEST: 0.1}))["term"].to_list() == [SECOND]


def test_few_changes_have_no_evidence(propose_by):
    assert propose_by(BARS, changes=59).select("value", "n").rows() == [(None, 59)] * 2


def test_step_is_huber_regression():
    """Through instruments, the design under its prior, the term under none; of neighbouring changes ten count as
    one."""
    rng = np.random.default_rng(2)
    p = len(hx.MEAN)
    instruments = rng.standard_normal((80, 8))
    columns = instruments @ rng.standard_normal((8, p + 1)) + 0.3 * rng.standard_normal((80, p + 1))
    left = columns[:, 0] * 0.5 + 0.1 * rng.standard_normal(80)
    left[::16] += 3.0
    design = hx.MEAN + 0.1 * hx.SD
    z = instruments @ np.linalg.pinv(instruments) @ columns
    weight = np.ones(80)
    scale = 1.4826 * np.median(np.abs(left))
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


def test_rms_clips_at_limit():
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
    gap = alter(rows, pl.col("flight_id") == "B_004", hx_in_k=None)
    dsm = with_bias(("B", 1), hx_out_k=0.5)
    steps = _flight_steps(gap, dsm)
    assert np.bincount(steps.fold).tolist() == [29, 29 + 8 + 29, 28 + 29, 29, 29]
    ordered = gap.drop_nulls("hx_in_k").sort("operator", "tail", "pack", "departed_at")
    ratio = ordered["ln_ua_ratio"].to_numpy()
    signals = {n: ordered[n].to_numpy() for n in hx.SIGNALS}
    here = hx.ln_conductance_ratio(signals, dsm.design, dsm.bias_of(ordered))
    np.testing.assert_allclose(steps.offset, ratio - here)
    np.testing.assert_allclose(steps.residual({}, dsm.design), np.diff(ratio)[steps.change])


def test_two_aircraft_fold_by_flight():
    """Fifths of the flights."""
    rows = pl.concat([cruise_of(30, "A", 0), cruise_of(30, "C", 2), cruise_of(9, "A", 9, pack=2)])
    assert len(np.unique(_flight_steps(rows, with_bias(("B", 1), hx_out_k=0.5)).fold)) == 5


@pytest.mark.parametrize(("most", "tails"), [(40, 4), (39, 2), (20, 2), (19, 2), (13, 1)])
def test_large_fleet_is_thinned_by_aircraft(monkeypatch, most, tails):
    """Every second aircraft, and again."""
    monkeypatch.setattr(missing_physics, "MOST_FLIGHTS", most)
    rows = pl.concat([cruise_of(10, t, k) for k, t in enumerate("ABCD")])
    assert _flight_steps(rows, DSM).change.sum() == tails * 9


def test_fleet_is_large_above_20000_flights():
    assert missing_physics.MOST_FLIGHTS == 20_000


SMALL_STEP = 0.02 * TERMS[BEST].bounds[1]


def test_term_is_fitted_in_five_steps(monkeypatch):
    """A step moves a term within its bounds, and the design by half at most."""
    p = len(hx.MEAN)
    answer = (np.r_[SMALL_STEP, np.full(p, 9.0)], np.arange(1.0, p + 2))
    monkeypatch.setattr(missing_physics, "_step", lambda *_: answer)
    fit = _fit(_flight_steps(cruise_of(30, "A", 1), DSM), DSM, (BEST,))
    assert (fit.terms[BEST], fit.sd.tolist()) == (pytest.approx(5 * SMALL_STEP), [1.0])
    np.testing.assert_allclose(fit.design, np.minimum(hx.MEAN + 2.5, hx.HIGH))


@pytest.fixture
def rounds(monkeypatch) -> list[dict[str, float]]:
    """Coefficients with which a calibration by stand-ins is gone through."""
    rounds: list = []
    monkeypatch.setattr(
        calibration, "_calibrate", lambda *args: (rounds.append(args[-1]), replace(DSM, terms=args[-1]))[1]
    )
    monkeypatch.setattr(calibration, "estimate_flights", lambda samples, _model: samples)
    monkeypatch.setattr(calibration, "coefficients", lambda *_: {BEST: SMALL_STEP, SECOND: 1e9})
    return rounds


@pytest.mark.parametrize(
    ("term", "values"),
    [(BEST, [0.0, SMALL_STEP, 2 * SMALL_STEP, 3 * SMALL_STEP]), (SECOND, [0.0, *[TERMS[SECOND].bounds[1]] * 3])],
)
def test_terms_are_accepted_in_three_rounds(rounds, term, values):
    calibrate(flights(2).rename({"departed_at": "time_utc"}), pl.DataFrame(), pl.DataFrame(), (BEST, SECOND))
    assert [r[term] for r in rounds] == pytest.approx(values)


def test_no_terms_take_one_round(rounds):
    calibrate(flights(2).rename({"departed_at": "time_utc"}), pl.DataFrame(), pl.DataFrame())
    assert rounds == [{}]


@pytest.fixture(scope="module")
def changes():
    """Changes of forty flights of three aircraft."""
    return _flight_steps(pl.concat([cruise_of(40, t, k) for k, t in enumerate("ABC")]), DSM)


def test_evidence_matches_hand_computation(changes):
    """The coefficient over its deviation, what is left out, and how much it moves the ratio."""
    fit = _fit(changes, DSM, (BEST,))
    row = _evidence(changes, DSM, BEST)
    f = (fit.terms[BEST] / fit.sd[0]) ** 2
    n = len(changes.fold)
    shift = changes.ratio(fit.terms, fit.design) - changes.ratio({}, DSM.design)
    assert row[2:4] == pytest.approx((fit.terms[BEST], fit.sd[0]))
    assert (row[5], row[6], row[8], row[9]) == pytest.approx((f - np.log(n), f, np.nanstd(shift), n))


def test_held_out_change_is_by_folds(changes):
    before = changes.residual({}, DSM.design)
    limit = 4.0 * 1.4826 * np.median(np.abs(before))
    after = np.empty(len(changes.fold))
    for fold in np.unique(changes.fold):
        out = changes.fold == fold
        other = _fit(changes, DSM, (BEST,), ~out)
        after[out] = changes.residual(other.terms, other.design)[out]
    ratio = np.sqrt(np.mean(np.clip(after, -limit, limit) ** 2) / np.mean(np.clip(before, -limit, limit) ** 2))
    assert _evidence(changes, DSM, BEST)[7] == pytest.approx(ratio - 1.0)


def test_columns_are_slopes_of_ratio(changes):
    steps = [changes.ratio({BEST: value}, DSM.design) for value in (0.25, 0.251)]
    slope = -np.diff(steps[1] - steps[0])[changes.change] / 1e-3
    np.testing.assert_allclose(_columns(changes, {BEST: 0.25}, DSM.design)[:, 0], slope, rtol=1e-8, atol=1e-12)
