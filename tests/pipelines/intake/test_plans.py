"""Planned checks and the cost table: what is wrong is named with file, row and column or key."""

import datetime as dt
from pathlib import Path

import polars as pl
import pytest

from pipelines.intake.costs import DEFAULTS, NAME, CostError, costs_or_fault, read_costs
from pipelines.intake.landing import list_landing
from pipelines.intake.logs import read_checks

NOW = dt.datetime(2024, 6, 19, tzinfo=dt.UTC)
GOOD = [("AAA", "T-1", "2024-07-01", "A12"), ("AAA", "T-2", "2024-09-01", "C1")]
BAD = [("A", "T-1", "2024-07-01", "A12"), ("AAA", "T-1", "soon", "A12"), ("AAA", "T-1", "2099-01-01", "A12")]
COLUMNS = ["operator", "tail", "date", "name"]


def drop(landing: Path, kind: str, rows: list[tuple]) -> None:
    (landing / "fleet.csv").write_text("operator,tail\n")
    frame = pl.DataFrame(rows, schema=COLUMNS, orient="row")
    if kind == "csv":
        frame.write_csv(landing / "checks.csv")
    else:
        frame.write_parquet(landing / "checks.parquet")


@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_bad_rows_are_quarantined_with_row_and_column_and_the_good_go_on(tmp_path, kind):
    drop(tmp_path, kind, [*GOOD, *BAD])
    (file,) = [f for f in list_landing(tmp_path).files if f.kind == "checks"]
    read = read_checks(file, NOW)
    assert [(r[0], r[1], str(r[2]), r[3]) for r in read.rows.rows()] == GOOD
    first = 4 if kind == "csv" else 3
    assert read.quarantine.select("row", "column_name", "reason").rows() == [
        (first, "operator, tail", "bad_key"),
        (first + 1, "date", "unreadable_time"),
        (first + 2, "date", "unreadable_time"),
    ]
    assert read.n_delivered == 5 == read.n_loaded + read.quarantine["n_rows"].sum()


def test_dates_of_parquet_may_be_dates(tmp_path):
    (tmp_path / "fleet.csv").write_text("operator,tail\n")
    day = dt.date(2024, 7, 1)
    times = pl.Series([dt.datetime(2024, 7, 1), dt.datetime(2024, 7, 2)])
    for dates in (pl.Series([day, None]), times):
        pl.DataFrame({"operator": ["AAA"] * 2, "tail": ["T-1"] * 2, "date": dates}).write_parquet(
            tmp_path / "checks.parquet"
        )
        (file,) = [f for f in list_landing(tmp_path).files if f.kind == "checks"]
        assert read_checks(file, NOW).rows["planned_on"][0] == day


@pytest.mark.parametrize("content", [b"", b"PAR1", b"operator,tail,date\n", b"PAR1" + bytes(40) + b"PAR1"])
def test_a_broken_file_is_told_and_nothing_comes_of_it(tmp_path, content):
    (tmp_path / "fleet.csv").write_text("operator,tail\n")
    (tmp_path / "checks.parquet").write_bytes(content)
    (file,) = [f for f in list_landing(tmp_path).files if f.kind == "checks"]
    read = read_checks(file, NOW)
    assert read.rows.is_empty()
    assert read.quarantine["reason"].to_list() == ["cannot_read_parquet"]


def test_without_a_file_the_defaults_count_and_say_so(tmp_path):
    costs = read_costs(tmp_path)
    assert set(costs["source"]) == {"default"}
    assert costs.filter(component="HX", item="wash")["cost"].item() == DEFAULTS["HX"]["wash"]


def test_what_the_file_says_counts_over_the_defaults(tmp_path):
    (tmp_path / NAME).write_text('currency = "EUR"\nhorizon_days = 14\n[HX]\nwash = 1234.5\n')
    costs = read_costs(tmp_path)
    assert set(costs["currency"]) == {"EUR"}
    assert set(costs["horizon_days"]) == {14}
    assert costs.filter(component="HX", item="wash").select("cost", "source").rows() == [(1234.5, NAME)]
    assert costs.filter(component="HX", item="replace")["source"].item() == "default"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[HX]\nwash = -1\n", r"costs\.toml: HX\.wash: is a number from 0 to 1e\+12, not -1"),
        ("[HX]\nwash = nan\n", r"costs\.toml: HX\.wash"),
        ('[HX]\nwash = "cheap"\n', r"costs\.toml: HX\.wash: is a number from 0 to 1e\+12, not 'cheap'"),
        ("[HX]\nwash = true\n", r"costs\.toml: HX\.wash"),
        ("[HX]\npolish = 1\n", r"costs\.toml: HX\.polish: means nothing; there are wash, replace"),
        ("[WING]\nwash = 1\n", r"costs\.toml: WING: is no table of a component"),
        ("HX = 3\n", r"costs\.toml: HX: is no table"),
        ("horizon_days = 0\n", r"costs\.toml: horizon_days: is a whole number of days"),
        ("currency = 3\n", r"costs\.toml: currency"),
        ("[HX\n", r"costs\.toml: can't be read"),
    ],
)
def test_a_bad_value_is_named_with_file_and_key_and_no_other_cost_is_told(tmp_path, text, message):
    (tmp_path / NAME).write_text(text)
    with pytest.raises(CostError, match=message):
        read_costs(tmp_path)
    costs, (fault,) = costs_or_fault(tmp_path)
    assert costs.is_empty()
    assert fault.reason == "bad_cost"
