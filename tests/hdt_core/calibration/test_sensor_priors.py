"""Two sensors of one thing: each takes its share of the difference, with the sign of its own error. By hand."""

import numpy as np
import polars as pl
import pytest
from by_hand import DSM, START, with_bias

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration.compressor import probe_corrections
from hdt_core.calibration.sensor_priors import exit_differences, sensor_prior

PACKS = pl.DataFrame({"operator": "TST", "tail": ["A", "A", "B", "B"], "pack": [1, 2, 1, 2]}).cast({"pack": pl.Int32})


def cruise(**columns: list[float | None]) -> pl.DataFrame:
    """One sample a pack."""
    sound = {"pack_flow_kg_s": 0.8, "cc_flow_kg_s": 0.8, "tat_k": 250.0, "cc_in_k": 250.0, "cc_in_pa": 3e4,
             "total_pressure_pa": 3e4, "cc_out_pa": 9e4, "altitude_m": 1e4}  # fmt: skip
    rows = PACKS.with_columns(pl.lit(v).alias(c) for c, v in sound.items())
    return rows.with_columns(pl.Series(c, v) for c, v in columns.items()).with_columns(
        flight_id=pl.lit("F"), time_utc=pl.lit(START)
    )


def test_flow_and_tat_take_their_share_of_what_a_pack_shows_beyond_the_fleet():
    """Pack flow and compressor flow, 2 % each, share evenly; TAT has 0.5 K against 1 K over the root of two packs."""
    rows = cruise(pack_flow_kg_s=[0.8 * np.exp(0.03), 0.8, 0.9, 0.9], cc_flow_kg_s=[0.8, 0.8, 0.9, 0.9],
                  tat_k=[251.0, 252.0, 253.0, 253.0], cc_in_k=[250.0, 250.0, 253.0, 253.0])  # fmt: skip
    mean, sd = sensor_prior(rows, PACKS)
    flow, tat = hx.BIASES.index("pack_flow_kg_s"), hx.BIASES.index("tat_k")
    np.testing.assert_allclose(mean[:, flow], [0.015, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(sd[:, flow], 0.02 * np.sqrt(0.5))
    share = 0.25 / (0.25 + 0.5)
    np.testing.assert_allclose(mean[:, tat], share * np.array([0.75, 0.75, -0.75, -0.75]))
    np.testing.assert_allclose(sd[:, tat], 0.5 * np.sqrt(1.0 - share))
    three = pl.concat([PACKS[:2], PACKS[:1].with_columns(pack=pl.lit(3, pl.Int32)), PACKS[2:]])
    apart = pl.Series([3.0, 1.0, 0.5, 0.0, 0.0])
    more = pl.concat([rows[:2], rows[:1], rows[2:]]).with_columns(pack=three["pack"], tat_k=pl.col("cc_in_k") + apart)
    share = 0.25 / (0.25 + 1.0 / 3.0)
    np.testing.assert_allclose(sensor_prior(more, three)[0][:3, tat], share * 0.0, atol=1e-12)
    np.testing.assert_allclose(sensor_prior(more, three)[0][3:, tat], 0.25 / 0.75 * -1.5)
    others = [k for k in range(6) if k not in (flow, tat)]
    assert not mean[:, others].any()
    np.testing.assert_allclose(sd[:, others], np.tile(hx.BIAS_SDS[others], (4, 1)))


def test_without_a_second_sensor_the_declared_error_stands():
    mean, sd = sensor_prior(cruise(cc_flow_kg_s=[None] * 4, cc_in_k=[None] * 4).cast({"cc_flow_kg_s": pl.Float64,
                            "cc_in_k": pl.Float64}), PACKS)  # fmt: skip
    assert not mean.any()
    np.testing.assert_allclose(sd, np.tile(hx.BIAS_SDS, (4, 1)))


def test_the_compressors_probes_take_theirs():
    """Its inlet has 1 K against TAT's 0.5 K: 0.8 of the difference; .3 % of pressure against .2 %: 9/13."""
    rows = cruise(cc_in_k=[252.0, 250.0, 253.0, 253.0], cc_in_pa=[3e4 * np.exp(0.01), 3e4, 2e4, 2e4],
                  tat_k=[250.0, 250.0, 253.0, 253.0], total_pressure_pa=[3e4, 3e4, 2e4, 2e4])  # fmt: skip
    corrections = probe_corrections(rows, PACKS)
    np.testing.assert_allclose(corrections["inlet_bias_k"], [1.6, 0.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(corrections["inlet_bias_ln"], [0.01 * 9.0 / 13.0, 0.0, 0.0, 0.0], atol=1e-12)
    assert corrections["exit_bias_ln"].to_list() == [0.0] * 4


@pytest.mark.parametrize(("n_flights", "enough"), [(9, False), (10, True)])
def test_exit_pressure_beyond_what_height_and_flow_call_for(n_flights, enough):
    """Of four packs ten flights each; one reads 1 % high, which varies more between packs than probes do."""
    rng = np.random.default_rng(2)
    beyond = [0.01, 0.0, -0.002, 0.002]
    rows = []
    for k in range(n_flights):
        height, flow = 1.0 + 0.1 * rng.standard_normal(), 0.8 * np.exp(0.1 * rng.standard_normal())
        out = np.exp(11.0 + 0.3 * height - 0.2 * height**2 + 0.5 * np.log(flow) + beyond)
        flows = {"pack_flow_kg_s": [1.2 * flow] * 4, "cc_flow_kg_s": [flow / 1.2] * 4}
        rows.append(cruise(altitude_m=[1e4 * height] * 4, cc_out_pa=out, **flows).with_columns(
            flight_id=pl.lit(f"F{k}")))  # fmt: skip
    corrections = probe_corrections(pl.concat(rows), PACKS)["exit_bias_ln"].to_numpy()
    share = min(0.8, 0.004**2 / np.var(beyond, ddof=1))
    want = share * (np.array(beyond) - np.median(beyond)) if enough else np.zeros(4)
    np.testing.assert_allclose(corrections, want, atol=1e-9)


@pytest.mark.parametrize(("doors", "apart"), [((0.5, 0.5), 6.0), ((0.95, 0.05), 6.0), ((0.5, 0.96), None)])
def test_exits_are_compared_while_both_doors_can_move(doors, apart):
    rows = pl.concat([
        PACKS[:2].with_columns(flight_id=pl.lit("F"), hx_out_k=pl.Series([300.0 + k, 294.0 + k]),
                               ram_door_open=pl.Series(doors))
        for k in (-1.0, 0.0, 0.0, 1.0)
    ])  # fmt: skip
    differences = exit_differences(rows).sort("pack")["apart_k"].to_list()
    assert differences == ([apart, -apart] if apart else [None, None])
    assert exit_differences(rows.filter(pl.col("pack") == 1))["apart_k"].to_list() == [None]


@pytest.mark.parametrize(("stuck", "is_compared"), [(1, True), (2, False)])
def test_doors_must_be_free_for_more_than_four_fifths_of_a_cruise(stuck, is_compared):
    doors = pl.int_range(pl.len()).over("pack") < stuck
    rows = pl.concat([PACKS[:2]] * 10).with_columns(
        flight_id=pl.lit("F"), hx_out_k=300.0 + 1.0 * pl.col("pack"),
        ram_door_open=pl.when(doors).then(1.0).otherwise(0.5),
    )  # fmt: skip
    assert exit_differences(rows)["apart_k"].is_not_null().all() == is_compared


def test_biases_are_taken_out_with_their_sign():
    """A sensor that reads high by its bias meets less than it reads; the flow's is a fraction."""
    signals = {n: np.array([v]) for n, v in zip((*hx.SIGNALS, "ram_out_k"), (1e4, 0.8, 250.0, 3e4, 400.0, 300.0, 0.4,
                                                0.8, 320.0), strict=True)}  # fmt: skip
    bias = np.array([[0.02], [1.0], [2.0], [-0.5], [0.01], [3.0]])
    corrected = hx.without_bias(signals, bias)
    assert corrected["pack_flow_kg_s"][0] == pytest.approx(0.8 * np.exp(-0.02))
    got = [corrected[n][0] for n in ("hx_in_k", "hx_out_k", "tat_k", "ram_door_open", "ram_out_k", "mach")]
    np.testing.assert_allclose(got, [399.0, 298.0, 250.5, 0.39, 317.0, 0.8])
    rows = PACKS.with_columns(pl.lit(0))
    dsm = with_bias(("A", 1), ("B", 2), hx_out_k=2.0, tat_k=-0.5)
    np.testing.assert_allclose(dsm.bias_of(rows)[2], [2.0, 0.0, 0.0, 2.0])
    np.testing.assert_allclose(dsm.bias_of(rows)[3], [-0.5, 0.0, 0.0, -0.5])
    assert not DSM.bias_of(rows).any()
