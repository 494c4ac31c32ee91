"""Units and wiring that physics refuses reach the reader: by file and column, in quarantine and by `hdt doctor`."""

import polars as pl
from nights import keep_base, run
from soundness import faults
from zones import drop_fleet, simulated

from pipelines.cli.doctor import examine
from pipelines.storage.catalog import connect


def check(home):
    return next(c for c in examine(None, home) if c.name == "units and wiring")


def test_what_is_written_otherwise_than_agreed_is_told(sample_home, tmp_path):
    landing, home = tmp_path / "landing", tmp_path / "home"
    zones = [simulated(31 + k, 3, operator=o, tail=t) for k, (o, t) in enumerate([("QQX", "Z9"), ("QQY", "Z9")])]
    swapped, fahrenheit, _ = zones[0].flights
    one, other = pl.col("hx_in_degc"), pl.col("hx_out_degc")
    wrong, warm = pl.col("flight_id") == swapped, pl.col("flight_id") == fahrenheit
    zones[0].snapshots = zones[0].snapshots.with_columns(
        pl.when(wrong).then(other).otherwise(one).alias("hx_in_degc"),
        pl.when(wrong).then(one).otherwise(other).alias("hx_out_degc"),
        pl.when(warm).then(pl.col("tat_degc") * 1.8 + 32).otherwise("tat_degc").alias("tat_degc"),
    )
    zones[0].maintenance = pl.DataFrame(
        {"done_on": ["1900-01-01", "2024-03-05"], "pack": [1, 3], "component": ["HX", "HX"],
         "action": ["REPLACED", "REPLACED"], "finding": ["", ""], "reference": ["WO1", "WO2"]}
    )  # fmt: skip
    drop_fleet(landing, zones)
    for zone in zones:
        zone.drop_csv(landing)
    zones[0].drop_papers(landing)
    keep_base(sample_home, home)
    assert run(landing, home).failed == {}
    assert faults(home, landing) == []
    with connect(home) as con:
        entries = con.execute(
            "select distinct file, reason, column_name from quarantine where scope != 'value'"
        ).fetchall()
    assert set(entries) == {
        (f"QQX/Z9/acms/{swapped}.csv", "swapped_columns", "hx_in_degc, hx_out_degc"),
        (f"QQX/Z9/acms/{fahrenheit}.csv", "wrong_unit", "tat_degc"),
        ("QQX/Z9/maintenance.csv", "too_early", "done_on"),
        ("QQX/Z9/maintenance.csv", "bad_pack", "pack"),
        ("QQX/Z9", "tail_of_two_operators", None),
        ("QQY/Z9", "tail_of_two_operators", None),
    }
    assert not check(home).well
    assert f"QQX/Z9/acms/{swapped}.csv: hx_in_degc, hx_out_degc swapped columns" in check(home).message


def test_a_sound_fleet_is_told_so(sample_home):
    assert check(sample_home).well
