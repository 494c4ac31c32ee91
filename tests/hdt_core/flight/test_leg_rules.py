"""Level one's rules at their edges, over legs written down sample by sample."""

from datetime import UTC, datetime, timedelta

import polars as pl
import pytest

from hdt_core.flight.legs import judge_legs, prepare_samples

TEXT = dict.fromkeys(("operator", "tail", "component", "action", "code"), pl.String)
NO_LOG = (
    pl.DataFrame(schema=TEXT | {"pack": pl.Int32, "done_on": pl.Date}),
    pl.DataFrame(schema=TEXT | {"pack": pl.Int32, "message_time": pl.Datetime("us", "UTC")}),
)
FLOWN = {
    "altitude_m": 11_000.0, "mach": 0.82, "tat_k": 250.0, "total_pressure_pa": 35_000.0, "hx_in_k": 405.0,
    "hx_out_k": 296.0, "ram_door_open": 0.3, "pack_flow_kg_s": 0.77, "ram_out_k": 335.0, "cc_speed_rad_s": 3_600.0,
    "cc_in_k": 251.0, "cc_in_pa": 33_500.0, "cc_out_k": 365.0, "cc_out_pa": 93_000.0, "cc_flow_kg_s": 0.8,
    "vda_counts": 400.0,
}  # fmt: skip


def leg(pack: int = 1, rows: int = 12, **changed: object) -> pl.DataFrame:
    """A cruise of snapshots three minutes apart, the noisy signals in motion."""
    wobble = [0.001 * (k % 3) for k in range(rows)]
    moving = ("pack_flow_kg_s", "cc_flow_kg_s", "cc_speed_rad_s")
    signals = FLOWN | {s: [FLOWN[s] * (1.0 + w) for w in wobble] for s in moving}
    at = [datetime(2024, 3, 1, 6, tzinfo=UTC) + timedelta(minutes=3 * k) for k in range(rows)]
    key = {"operator": "TST", "tail": "T", "flight_id": "F", "pack": pack, "source": "acms", "phase_code": None}
    frame = pl.DataFrame(key | {"time_utc": at} | signals | changed, strict=False)
    typed = {"pack": pl.Int32, "time_utc": pl.Datetime("us", "UTC"), "phase_code": pl.String}
    return frame.cast(typed | dict.fromkeys(FLOWN, pl.Float64))


def reasons(*packs: pl.DataFrame) -> list[str]:
    return judge_legs(pl.concat(packs), *NO_LOG)[0].sort("pack")["reason"].to_list()


def some(value: float, n: int, rest: float, rows: int = 12) -> list[float]:
    return [value] * n + [rest] * (rows - n)


def test_a_sound_cruise_is_admitted_with_its_figures():
    legs, samples = judge_legs(leg(), *NO_LOG)
    row = legs.row(0, named=True)
    assert (row["reason"], row["admitted"], row["source"]) == ("", True, "acms")
    assert (row["n_samples"], row["n_snapshots"], row["n_monitored"], row["n_nominal"]) == (12, 12, 12, 12)
    assert row["cruise_minutes"] == 33.0
    assert samples["nominal"].all()


@pytest.mark.parametrize(("flow", "reason"), [(0.1999, "PACK_OFF"), (0.2, "NO_CRUISE"), (0.21, "")])
def test_a_pack_is_off_below_a_fifth(flow, reason):
    at_rest = [flow * (1.0 + 1e-7 * k) for k in range(12)]
    codes = reasons(leg(pack_flow_kg_s=at_rest), leg(2))
    assert codes == [reason if flow != 0.2 else "", "OTHER_PACK_OFF" if reason == "PACK_OFF" else ""]


@pytest.mark.parametrize(
    ("rows", "n", "missing"), [(24, 3, True), (20, 2, False), (26, 3, False), (25, 3, False), (17, 2, False)]
)
def test_a_fitted_sensor_misses_three_readings_and_12_per_cent(rows, n, missing):
    gaps = [None] * n + [335.0] * (rows - n)
    assert reasons(leg(rows=rows, ram_out_k=gaps)) == ["SENSOR_MISSING" if missing else ""]
    assert reasons(leg(rows=rows, ram_out_k=None), leg(2, rows=rows, ram_out_k=None)) == ["", ""]
    assert reasons(leg(rows=rows, ram_out_k=None), leg(2, rows=rows)) == ["SENSOR_MISSING", ""]


@pytest.mark.parametrize(
    ("tat_k", "altitude_m", "icing"),
    [(268.15, 6699.0, 1), (268.14, 6699.0, 0), (283.15, 6699.0, 1), (283.16, 6699.0, 0), (270.0, 6700.0, 0)],
)
def test_icing_is_wet_cold_air_below_22000_feet(tat_k, altitude_m, icing):
    codes = reasons(leg(tat_k=tat_k, altitude_m=altitude_m))
    assert codes == ["ICING" if icing else ""]


def test_two_nominal_samples_make_a_leg():
    for left, reason in ((2, ""), (1, "ICING")):
        assert reasons(leg(altitude_m=6000.0, tat_k=some(270.0, 12 - left, 250.0))) == [reason]
    for steady, reason in ((2, "NO_CRUISE"), (3, "")):
        height = [9000.0 + 200.0 * k for k in range(12 - steady)] + [11_500.0] * steady
        pa = {name: [42_000.0 - 700.0 * k for k in range(12)] for name in ("total_pressure_pa", "cc_in_pa")}
        assert reasons(leg(altitude_m=height, **pa)) == [reason]


@pytest.mark.parametrize(
    ("span", "rise_m", "rows", "still"),
    [
        (0.034, 4100.0, 12, True), (0.036, 4100.0, 12, False), (0.034, 4000.0, 12, False), (0.034, 4100.0, 7, False),
        (0.034, 4100.0, 8, True),
    ],
)  # fmt: skip
def test_a_door_that_follows_no_climb_is_jammed(span, rise_m, rows, still):
    door = [0.3 + span * (k % 2) for k in range(rows)]
    height = [11_000.0 - rise_m, 11_000.0 - rise_m / 2.0] + [11_000.0] * (rows - 2)
    pa = {name: [60_000.0, 47_000.0] + [FLOWN[name]] * (rows - 2) for name in ("total_pressure_pa", "cc_in_pa")}
    assert reasons(leg(rows=rows, ram_door_open=door, altitude_m=height, **pa)) == ["DOOR_STILL" if still else ""]


def test_a_row_recorded_twice_counts_once_and_a_gap_is_not_monitored():
    twice = pl.concat([leg(), leg()])
    assert prepare_samples(twice).height == 12
    assert prepare_samples(pl.concat([leg(rows=1), leg(2, rows=1)])).height == 2
    holed = prepare_samples(leg(hx_out_k=[None] + [296.0] * 11))
    assert holed["monitored"].to_list() == [False] + [True] * 11
    assert prepare_samples(leg(vda_counts=None))["monitored"].all()
