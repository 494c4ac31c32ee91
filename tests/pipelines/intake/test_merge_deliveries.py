"""Late, repeated and out-of-order deliveries end where a clean delivery ends."""

import random
from datetime import timedelta

import polars as pl
import pytest
from accounts import balances
from hypothesis import given, settings
from hypothesis import strategies as st
from spoils import field, parquet, retimed

from pipelines.intake import merge
from pipelines.intake.columns import SIGNAL_COLUMNS
from pipelines.intake.landing import list_landing
from pipelines.intake.merge import merge_deliveries

CSV = "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
COPY = "AQX/LX-AAA/acms/copy.csv"


def test_conflicting_row_is_set_aside(good_flight, deliver, read):
    files = deliver({CSV: good_flight, COPY: field(5, "hx_out_degc", b"77.5")(good_flight)})
    merged = merge_deliveries([read(files).rows], {f.path: f.received_at for f in files})
    assert (merged.rows.height, merged.duplicates["n_duplicate"].sum()) == (42, 41)
    (conflict,) = merged.quarantine.rows(named=True)
    expected = {"reason": "conflicting_delivery", "scope": "row", "row": 6, "column_name": "hx_out_k"}
    assert expected.items() <= conflict.items()
    assert (CSV in conflict["detail"]) != (conflict["file"] == CSV)
    assert conflict["received_at"] is not None


def test_extra_value_is_set_aside(good_flight, deliver, read):
    files = deliver({CSV: field(5, "hx_out_degc", b"")(good_flight), COPY: field(5, "tat_degc", b"")(good_flight)})

    merged = merge_deliveries([read(files).rows], {})

    (conflict,) = merged.quarantine.rows(named=True)
    stored = merged.rows.filter(pl.any_horizontal(pl.col("hx_out_k", "tat_k").is_null()))
    lacked = stored.select("hx_out_k", "tat_k").unpivot().filter(pl.col("value").is_null())["variable"].to_list()
    assert [conflict["column_name"]] == lacked


@pytest.mark.parametrize(
    ("to_time", "n_stored"), [(lambda t: "2024-05-25T17:00:00Z", 2), (lambda t: t[:-3] + "00Z", 42)]
)
def test_simultaneous_reports_have_own_reason(good_flight, deliver, read, to_time, n_stored):
    (file,) = deliver({CSV: retimed(to_time)(good_flight)})

    merged = merge_deliveries([read([file]).rows], {})

    assert merged.rows.height == n_stored
    assert merged.quarantine["reason"].to_list() == ["same_time"] * (42 - n_stored)


def test_unlisted_rows_name_their_flight(good_flight, deliver, read, monkeypatch):
    monkeypatch.setattr(merge, "MAX_ROWS_LISTED", 3)
    (file,) = deliver({CSV: retimed(lambda t: "2024-05-25T17:00:00Z")(good_flight)})

    conflicts = merge_deliveries([read([file]).rows], {}).quarantine

    assert conflicts["n_rows"].to_list() == [1, 1, 1, 37]
    assert conflicts["flight_id"].unique().to_list() == ["LX-AAA_20240525_04"]


def test_conflicting_history_is_set_aside(good_flight, deliver, read):
    contents = parquet(good_flight), parquet(field(5, "hx_out_degc", b"77.5")(good_flight))
    names = (f"AQX/LX-AAA/acms/history_2024-05{more}.parquet" for more in ("", " (1)"))
    files = dict(zip(names, contents, strict=True))
    merged = merge_deliveries([read(deliver(files)).rows], {})
    assert (merged.rows.height, merged.duplicates["n_duplicate"].sum()) == (42, 41)
    (conflict,) = merged.quarantine.rows(named=True)
    assert (conflict["reason"], conflict["row"], conflict["column_name"]) == ("conflicting_delivery", 5, "hx_out_k")
    assert sum(name in conflict["detail"] for name in files) == 1


@pytest.fixture(scope="module")
def read_zone(tmp_path_factory, read):
    """Writes files of a landing zone, and reads it: the files and what came of them."""
    root = tmp_path_factory.mktemp("zone")

    def write(files: dict[str, bytes]):
        for name, content in files.items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_bytes(content)
        listed = [f for f in list_landing(root).files if f.path in files]
        return listed, read(listed)

    return write


@pytest.fixture(scope="module")
def growing(good_flight, read_zone):
    return (lambda cut: read_zone({CSV: good_flight[:-cut]})[1]), read_zone({CSV: good_flight})[1]


@settings(max_examples=60, deadline=None)
@given(cut=st.integers(1, 2500))
def test_growing_file_adds_nothing_false(growing, cut):
    """What is read of it stands in the whole file, too, wherever its end was; which then loses and doubles nothing."""
    read_part, whole = growing
    part = read_part(cut)
    assert part.rows.join(whole.rows, on=part.rows.columns, how="anti", nulls_equal=True).is_empty()
    assert part.rows.height >= part.delivered["n_delivered"].sum() - 1
    merged = merge_deliveries([whole.rows, part.rows], {})
    assert merged.rows.height == 42
    assert merged.quarantine.is_empty()


@pytest.mark.parametrize(("fuller", "poorer"), [(COPY, CSV), (CSV, COPY)])
def test_fuller_delivery_wins(good_flight, deliver, read, fuller, poorer):
    files = deliver({fuller: good_flight, poorer: field(5, "hx_out_degc", b"")(good_flight)})
    merged = merge_deliveries([read(files).rows], {})
    assert merged.rows["hx_out_k"].null_count() == 0
    assert merged.quarantine.is_empty()


@pytest.fixture
def rows(good_flight, deliver, read) -> pl.DataFrame:
    """Rows of the good flight."""
    return read(deliver({CSV: good_flight})).rows


def test_rounded_numbers_are_the_same(rows):
    """As they are where they went through 32 bits."""
    names = [c.si_name for c in SIGNAL_COLUMNS]
    rounded = rows.with_columns(pl.col(names).cast(pl.Float32).cast(pl.Float64), file=pl.lit(COPY))
    merged = merge_deliveries([rows, rounded], {})
    assert (merged.rows.height, merged.quarantine.height) == (42, 0)


def test_log_is_another_record(rows):
    assert merge_deliveries([rows, rows.with_columns(source=pl.lit("cpl"))], {}).rows.height == 84


def test_no_rows_merge_to_none(rows):
    assert all(f.is_empty() for f in merge_deliveries([rows.clear()], {}))


def at_other_times(rows: pl.DataFrame, seconds: int) -> pl.DataFrame:
    """Rows of another file whose clock is ahead."""
    return rows.with_columns(pl.col("time_utc") + timedelta(seconds=seconds), file=pl.lit(COPY))


@pytest.mark.parametrize("seconds", [7, 30, -3_600, 3 * 3_600, -5 * 3_600])
def test_flight_at_other_times_is_one(rows, seconds):
    merged = merge_deliveries([rows, at_other_times(rows, seconds)], {})
    assert merged.rows.equals(merge_deliveries([rows], {}).rows)
    assert merged.quarantine["reason"].to_list() == ["conflicting_delivery"] * 42


def test_other_times_are_told(rows):
    told = merge_deliveries([rows, at_other_times(rows, 7)], {}).quarantine
    assert told["detail"].str.contains(f"repeats {CSV} at other times", literal=True).all()


def test_copy_at_whole_minutes_is_seen(rows):
    whole = rows.with_columns(pl.col("time_utc").dt.truncate("1m"), file=pl.lit(COPY))
    assert merge_deliveries([rows, whole], {}).rows["file"].unique().to_list() == [CSV]


def test_rounded_copy_is_seen(rows):
    tenths = (pl.col(c.si_name).sub(c.offset).truediv(c.scale).round(1) * c.scale + c.offset for c in SIGNAL_COLUMNS)
    rounded = at_other_times(rows, 7).with_columns(tenths)
    assert merge_deliveries([rows, rounded], {}).rows.height == 42


def test_fuller_copy_is_stored(rows):
    copy = at_other_times(rows, 7)
    stored = merge_deliveries([rows.head(20), copy], {}).rows
    assert stored["file"].unique().to_list() == [COPY]


def test_copy_of_two_parts_is_seen(rows):
    """Neither part alone holds most of it."""
    parts = rows.with_columns(file=pl.when(pl.col("pack") == 1).then(pl.lit("a")).otherwise(pl.lit("b")))
    merged = merge_deliveries([parts, at_other_times(rows.tail(20), 7)], {})
    assert merged.rows["file"].value_counts(sort=True)["count"].to_list() == [21, 21]


NTH_TIME = pl.col("time_utc").rank("dense")


@pytest.mark.parametrize(
    "in_copy",
    [NTH_TIME % 2 == 0, NTH_TIME % 3 == 0, NTH_TIME > 10, pl.col("pack") == 2],
    ids=["alternate", "each third", "later", "pack"],
)
def test_parts_complete_each_other(rows, in_copy):
    parts = rows.with_columns(file=pl.when(in_copy).then(pl.lit(COPY)).otherwise("file"))
    merged = merge_deliveries([parts], {})
    assert (merged.rows.height, merged.quarantine.height) == (42, 0)


def test_constant_reports_prove_no_copy(rows):
    still = rows.with_columns(pl.col(c.si_name).first().over("pack") for c in SIGNAL_COLUMNS)
    parts = still.with_columns(file=pl.when(NTH_TIME % 2 == 0).then(pl.lit(COPY)).otherwise("file"))
    assert merge_deliveries([parts], {}).rows.height == 42


@pytest.mark.parametrize(("n_reports", "n_stored"), [(4, 46), (5, 42)])
def test_five_reports_prove_a_copy(rows, n_reports, n_stored):
    few = at_other_times(rows.filter(pack=1).head(n_reports), 7)
    assert merge_deliveries([rows, few], {}).rows.height == n_stored


def warmer(rows: pl.DataFrame, file: str) -> pl.DataFrame:
    """Rows of another file with other values."""
    return rows.with_columns(pl.col("hx_out_k") + 2.0, file=pl.lit(file))


def winner(*deliveries: pl.DataFrame) -> str:
    """The one file whose rows are stored."""
    (file,) = merge_deliveries(deliveries, {}).rows["file"].unique()
    return file


def test_numbered_copy_is_not_named_after_its_flight(rows):
    assert winner(rows, warmer(rows, CSV.replace(".csv", " (1).csv"))) == CSV


@pytest.mark.parametrize("n_rows", [42, 41])
def test_rows_count_before_values(rows, n_rows):
    """The file that is named after the flight lacks a signal."""
    poor = rows.with_columns(tat_k=pl.lit(None, pl.Float64))

    assert winner(poor, warmer(rows, COPY).head(n_rows)) == (COPY if n_rows == 42 else CSV)


def test_missing_value_contradicts_no_other(rows):
    """Each half has a row of the other, and one of them less of it."""
    first = rows.head(22).with_columns(tat_k=pl.when(pl.int_range(pl.len()) < 21).then("tat_k"))
    merged = merge_deliveries([first, rows.tail(21).with_columns(file=pl.lit(COPY))], {})

    assert (merged.rows.height, merged.quarantine.height) == (42, 0)


def test_log_at_other_times_is_no_copy(rows):
    log = rows.with_columns(source=pl.lit("cpl"))

    assert merge_deliveries([log, at_other_times(log, 7)], {}).rows.height == 84


def two_days(rows: pl.DataFrame) -> pl.DataFrame:
    """The later half a day later."""
    is_late = NTH_TIME > 10
    return rows.with_columns(pl.when(is_late).then(pl.col("time_utc") + timedelta(days=1)).otherwise("time_utc"))


def test_later_file_has_the_note(rows):
    parts = two_days(rows).with_columns(file=pl.when(NTH_TIME > 10).then(pl.lit(CSV)).otherwise(pl.lit(COPY)))

    assert merge_deliveries([parts], {}).quarantine.select("file", "reason").rows() == [(CSV, "clock_jump")]


def test_silence_in_one_file_is_its_own(rows):
    """The file's intake notes it."""
    whole = two_days(rows)
    merged = merge_deliveries([whole, warmer(whole.head(4), COPY)], {})

    assert merged.quarantine["reason"].unique().to_list() == ["conflicting_delivery"]


@pytest.fixture(scope="module")
def three_deliveries(good_flight, read_zone):
    spoiled = field(9, "vda_pos", b"")(field(5, "mach", b"0.5")(good_flight))
    files, intake = read_zone({CSV: good_flight, COPY: good_flight, "AQX/LX-AAA/acms/third.csv": spoiled})
    at = {f.path: f.received_at for f in files}
    return intake, at, merge_deliveries([intake.rows], at)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32))
@pytest.mark.usefixtures("tmp_path")
def test_delivery_order_changes_nothing(seed, three_deliveries):
    """Rows, quarantine and ledger are the same for any order of files and of rows within the frames."""
    intake, at, clean = three_deliveries
    rng = random.Random(seed)
    frames = [f.sample(fraction=1.0, shuffle=True, seed=seed) for f in intake.rows.partition_by("file")]
    rng.shuffle(frames)
    merged = merge_deliveries(frames, at)
    assert merged.rows.equals(clean.rows)
    assert merged.duplicates.equals(clean.duplicates)
    assert merged.quarantine.sort("file", "row").equals(clean.quarantine.sort("file", "row"))
    assert balances(intake.delivered, merged.rows, merged.duplicates, merged.quarantine)
