"""A fault laid over recorded flights: the physics it obeys, the truth it tells, and what the twin makes of it."""

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from pages import walk
from polars.testing import assert_frame_equal

from hdt_benchmark.fault_injection import DoorLimit, Fouling, SensorFault, inject
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.physics.heat_exchanger import mean_specific_heat_j_kg_k
from hdt_core.simulate.recorder import LB_PER_MIN
from hdt_core.tracking.track import track

PACK = 2
KEY = ["flight_id", "pack", "report_time"]
TOUCHED = ("ram_door_pct", "hx_out_degc", "ram_out_degc")


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """Names that the how-to leaves, its printed numbers checked on the way."""
    with pytest.MonkeyPatch.context() as patched:
        patched.chdir(Path(__file__).parents[3])
        return walk("howto-trial.md")


@pytest.fixture(scope="module")
def rows(page) -> pl.DataFrame:
    """Snapshots of one aircraft, with a ram outlet sensor that reads what the heat balance says at 1.5 kg/s."""
    cooled = pl.col("hx_in_degc") - pl.col("hx_out_degc")
    snapshots = page["rows"]["A9-BAC"].drop("ram_out_degc", strict=False)
    warmed = cooled * pl.col("pack_flow_lbpm") * LB_PER_MIN / 1.5
    return snapshots.with_columns(ram_out_degc=pl.col("tat_degc") + warmed)


@pytest.fixture(scope="module")
def lay(page, rows):
    """Lays a fault over the rows, from the how-to's first flight on."""

    def lay(fault, **options):
        return inject(rows, fault, pack=PACK, first_flight=page["first"], **options)

    return lay


def cruise(frame: pl.DataFrame, truth: pl.DataFrame) -> pl.DataFrame:
    """Rows of the faulty flights in level cruise, with their truth."""
    late = truth.filter(pl.col("since").is_not_null())
    return frame.join(late, on=["flight_id", "pack"]).filter(pl.col("altitude_ft") > 30_000)


@pytest.mark.parametrize("fault", [Fouling(0.0), Fouling(0.0, masked=False), DoorLimit(1.0)], ids=str)
def test_no_fault_changes_nothing(lay, rows, fault):
    # the door is found by bisection, to a ten-millionth of its travel
    assert_frame_equal(lay(fault).rows, rows, check_exact=False, abs_tol=1e-4)


@pytest.mark.parametrize("fault", [Fouling(0.3), DoorLimit(0.2), SensorFault("hx_out_degc", "step", 5.0)], ids=str)
def test_fault_spares_other_rows(lay, rows, fault):
    """Those of the other pack and of earlier flights, and all other columns."""
    injected = lay(fault)
    assert_frame_equal(injected.rows.drop(TOUCHED), rows.drop(TOUCHED))
    sound = injected.truth.filter(pl.col("since").is_null())["flight_id"].implode()
    spared = (pl.col("pack") != PACK) | pl.col("flight_id").is_in(sound)
    assert_frame_equal(injected.rows.filter(spared), rows.filter(spared))
    assert not injected.rows.filter(~spared).equals(rows.filter(~spared))


def test_door_opens_before_outlet_warms(lay, rows):
    injected = lay(Fouling(0.15))
    before = rows.select(*KEY, "ram_door_pct", "hx_out_degc")
    both = cruise(injected.rows, injected.truth).join(before, on=KEY, suffix="_before")
    complete = both.drop_nulls([*TOUCHED, "hx_in_degc", "tat_degc", "pt_psia", "pack_flow_lbpm", "altitude_ft", "mach"])
    door = complete["ram_door_pct"]
    warmer = complete["hx_out_degc"] - complete["hx_out_degc_before"]
    assert (door >= complete["ram_door_pct_before"] - 1e-9).all()
    modulating = door < 99.99
    assert 0.3 < modulating.mean() < 0.99
    assert warmer.filter(modulating).abs().max() < 1e-3
    assert warmer.filter(~modulating).min() > -1e-3
    assert warmer.filter(~modulating).max() > 0.5


def test_ram_air_lacks_retained_heat(page, lay, rows):
    injected = lay(Fouling(0.3, masked=False), **page["ours"])
    before = rows.select(*KEY, "hx_out_degc", "ram_out_degc")
    both = cruise(injected.rows, injected.truth).join(before, on=KEY, suffix="_before")
    complete = both.drop_nulls(["hx_in_degc", "hx_out_degc", "ram_out_degc"])
    air = {
        "total_pressure_pa": 6894.757293168 * complete["pt_psia"].to_numpy(),
        "tat_k": complete["tat_degc"].to_numpy() + 273.15,
        "altitude_m": 0.3048 * complete["altitude_ft"].to_numpy(),
        "mach": complete["mach"].to_numpy(),
        "ram_door_open": 0.01 * complete["ram_door_pct"].to_numpy(),
    }
    ram_kg_s = page["ours"]["duct"].predict({}, air)["ram_flow_kg_s"]
    columns = ("hx_out_degc", "hx_out_degc_before", "ram_out_degc", "ram_out_degc_before")
    out_k, before_k, ram_k, ram_before_k = (complete[c].to_numpy() + 273.15 for c in columns)
    hot_w_k = complete["pack_flow_lbpm"].to_numpy() * LB_PER_MIN * mean_specific_heat_j_kg_k(before_k, out_k)
    hot_w = hot_w_k * (out_k - before_k)
    lacks = ram_kg_s * mean_specific_heat_j_kg_k(ram_k, ram_before_k) * (ram_before_k - ram_k)
    clear = np.isfinite(hot_w) & np.isfinite(lacks)
    assert clear.sum() > 1000
    # changes are laid over recorded temperatures, whose specific heats are not quite those of the physics'
    np.testing.assert_allclose(lacks[clear], hot_w[clear], rtol=3e-3, atol=1e-3)


def test_twin_recovers_injected_loss(page):
    """Flight by flight, within half a point by the fleet's own map, within three on average by one it does not know."""
    for (_, of), loss in page["losses"].items():
        off = loss["estimate"] - loss["hx_fouling"]
        limit = 0.005 if of == "the fleet's own map" else 0.03
        assert loss.height > 150
        assert abs(off.mean()) < limit
        assert off.std() < limit


def test_short_door_is_no_loss(page):
    loss = page["estimated_loss"](DoorLimit(0.3), **page["ours"])
    assert loss["estimate"].abs().max() < 0.01
    assert (loss["ram_door_reach"] == 0.3).all()
    assert (loss["hx_out_k_after"] - loss["hx_out_k"]).mean() > 2.0


def test_health_track_rises_by_loss(page):
    """Filtered along the pack like any wear: within three of its standard deviations, and six points, in the end.

    The log is kept: it has spoken of an inspection. In one that says nothing at all a new core may be missing.
    """
    tail = page["TAIL"]
    first = page["first"]
    flown = page["as_flown"].filter(pl.col("tail") == tail)
    place = {"operator": flown["operator"][0], "tail": tail, "pack": PACK, "component": "HX"}
    inspection = place | {"action": "INSPECTED", "done_on": flown["departed_at"].dt.date().min()}
    log = pl.concat([page["no_work"], pl.DataFrame([inspection])], how="diagonal_relaxed")
    injected = inject(page["rows"][tail], Fouling(0.25, over_flights=100), pack=PACK, first_flight=first)
    after = estimate_flights(page["admitted_legs"](injected.rows, tail)[1], page["dsm"])
    both = [track(f, log, page["dsm"]).health for f in (after, flown)]
    late, before = (t.filter(parameter="hx_fouling", pack=PACK).sort("departed_at").tail(40) for t in both)
    expected = 1.0 - (1.0 - 0.25) * (1.0 - before["value"].to_numpy())
    off = late["value"].to_numpy() - expected
    assert np.abs(off).max() < 0.06
    assert (np.abs(off) < 3.0 * late["sd"].to_numpy()).all()


@pytest.mark.parametrize(("kind", "late"), [("step", 3.0), ("drift", 6.0)])
def test_sensor_fault_has_declared_size(lay, rows, kind, late):
    injected = lay(SensorFault("tat_degc", kind, 3.0))
    shifts = injected.rows.with_columns(error=injected.rows["tat_degc"] - rows["tat_degc"])
    error = shifts.join(injected.truth, on=["flight_id", "pack"]).drop_nulls(["since", "error"])
    np.testing.assert_allclose(error.filter(pl.col("since") >= 50)["error"], late)
    np.testing.assert_allclose(error.filter(pl.col("since") == 25)["error"], 3.0)
    assert injected.truth["sensor_fault"].unique().sort().to_list() == ["", "tat_degc"]


def faulty_readings(injected) -> pl.Series:
    """Exchanger's outlet on the flights with the fault."""
    return injected.rows.join(injected.truth.drop_nulls("since"), on=["flight_id", "pack"])["hx_out_degc"]


def test_stuck_sensor_repeats_itself(lay):
    assert faulty_readings(lay(SensorFault("hx_out_degc", "stuck"))).n_unique() == 1


def test_dropout_leaves_gaps(lay):
    """The same ones by the same seed."""
    first, again = (lay(SensorFault("hx_out_degc", "dropout"), seed=4) for _ in range(2))
    assert_frame_equal(first.rows, again.rows)
    assert 0.65 < faulty_readings(first).is_null().mean() < 0.75


@pytest.mark.parametrize(
    ("fault", "arguments", "message"),
    [
        (SensorFault, ("cabin_degc", "step", 1.0), "cabin_degc is no recorded signal; there are altitude_ft"),
        (Fouling, (1.0,), "a loss lies in"),
        (DoorLimit, (30.0,), "a door's reach"),
    ],
)
def test_impossible_fault_is_refused(fault, arguments, message):
    with pytest.raises(ValueError, match=message):
        fault(*arguments)


def test_unknown_flight_is_refused(rows):
    with pytest.raises(ValueError, match="pack 2 has no flight A9-BAC_19990101_01"):
        inject(rows, Fouling(0.1), pack=2, first_flight="A9-BAC_19990101_01")


def test_lacking_column_is_refused(page, rows):
    with pytest.raises(ValueError, match="the rows lack pt_psia"):
        inject(rows.drop("pt_psia"), Fouling(0.1), pack=PACK, first_flight=page["first"])
