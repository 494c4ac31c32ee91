"""A continuous log whose clock is not that of its flight's reports."""

from datetime import timedelta

import polars as pl

from pipelines.storage.catalog import connect
from tests.support.nights import run


def test_night_leaves_out_contradicted_log(own_home):
    landing, home = own_home
    log = sorted(landing.glob("*/*/cpl/*.parquet"))[0]
    rows = pl.read_parquet(log)
    rows.with_columns(pl.col("report_time") + timedelta(hours=1)).write_parquet(log)

    run(landing, home)

    with connect(home) as con:
        faults = con.sql("select file, reason, is_used from held_flights").fetchall()
        source = con.execute("select source from flights where flight_id = ?", [log.stem]).fetchall()
    assert faults == [(log.relative_to(landing).as_posix(), "log_contradicts", True)]
    assert source == [("acms",)]
