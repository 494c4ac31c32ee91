"""Classes of bad input that `test_dirty_landing` lacks: what was done to a good flight, what must become of it."""

from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

import polars as pl
import pytest
import spoils as by

from pipelines.intake.faults import REASONS
from pipelines.intake.merge import merge_deliveries

FLIGHT = "LX-AAA_20240525_04"
CSV = f"AQX/LX-AAA/acms/{FLIGHT}.csv"
HISTORY = "AQX/LX-AAA/acms/history_2024-05.parquet"
CPL = f"AQX/LX-AAA/cpl/{FLIGHT}.parquet"
N = 42  # rows of the good flight


@dataclass(frozen=True)
class Case:
    """What was done, and what must become of it."""

    name: str
    spoil: by.Spoil
    reason: str | None
    n_entries: int = 1
    n_stored: int = N
    column: str | None = None
    path: str = CSV


def later(content: bytes, hours: int) -> bytes:
    """The same reports, hours later."""
    shift = timedelta(hours=hours)
    return by.retimed(lambda t: (datetime.fromisoformat(t[:-1]) + shift).isoformat() + "Z")(content)


KEEP = Case("good", lambda c: c, None)
CASES = [
    KEEP,
    # transfer
    Case("cut in the middle of a row", lambda c: c[:-40], "cut_short", n_stored=N - 1),
    Case("number cut short", lambda c: c[:-3], "cut_short", n_stored=N - 1),
    Case("last value gone", lambda c: c[: c.rstrip().rindex(b",") + 1], "cut_short", n_stored=N - 1),
    Case("no newline at the end, number whole", lambda c: c[:-1], None),
    Case("half-written: header cut", lambda c: c[:60], "missing_columns", n_stored=0, column="pack"),
    Case("blank lines only", lambda c: b"\n \n\n", "empty_file", n_stored=0),
    Case("a header of a megabyte", lambda c: b"a," * 500_000 + b"\n" + c, "no_header", n_stored=0),
    Case("blank lines between rows", lambda c: c.replace(b"\n", b"\n\n"), None),
    Case("Parquet under the name of a CSV", by.parquet, "not_text", n_stored=0),
    Case("NUL in a row", by.line_as(5, b"LX-AAA\x00,,,"), "bad_bytes", n_stored=N - 1),
    Case("invalid UTF-8 in a row", by.line_as(5, b"LX-AAA\xff,,,"), "bad_bytes", n_stored=N - 1),
    Case("two files glued together", lambda c: c + c, "repeated_header", n_stored=2 * N),
    # shape
    Case("one field too few", lambda c: c.replace(b",CL,", b",", 1), "wrong_field_count", n_stored=N - 1),
    Case("one too many and one too few", lambda c: c.replace(b",CL,", b",CL,7,", 1).replace(b",DS,", b",", 1),
         "wrong_field_count", n_entries=2, n_stored=N - 2),
    Case("quote that never closes", lambda c: c.replace(b",CL,", b',"CL,', 1), "bad_quoting", n_stored=N - 1),
    Case("every field quoted", lambda c: by.joined([[b'"%s"' % f for f in x] for x in by.fields_of(c)]), None),
    Case("tabs", lambda c: c.replace(b",", b"\t"), "wrong_separator", n_stored=0),
    Case("Windows line ends", lambda c: c.replace(b"\n", b"\r\n"), None),
    Case("UTF-8 byte order mark", lambda c: b"\xef\xbb\xbf" + c, "other_encoding"),
    Case("UTF-16", lambda c: c.decode().encode("utf-16"), "other_encoding"),
    Case("UTF-16 without mark", lambda c: c.decode().encode("utf-16-le"), "not_text", n_stored=0),
    # columns
    Case("column renamed", by.rename("hx_in_degc", "T_HX_IN"), "missing_columns", n_stored=0, column="hx_in_degc"),
    Case("key missing", by.drop("pack"), "missing_columns", n_stored=0, column="pack"),
    Case("sensor not recorded by this operator", by.drop("cc_out_degc", "ram_out_degc", "pt_psia"), None),
    Case("extra column", by.extra, "extra_columns", column="operator_remark"),
    Case("extra column where a sensor is missing", lambda c: by.extra(by.drop("ram_out_degc")(c)), "extra_columns"),
    Case("column twice", by.rename("hx_in_degc", "hx_out_degc"), "repeated_column", n_stored=0, column="hx_out_degc"),
    Case("columns reordered", by.reorder, None),
    Case("names in capitals", lambda c: c.replace(c.split(b"\n")[0], c.split(b"\n")[0].upper()), "other_spelling"),
    # values
    Case("NaN", by.field(7, "pt_psia", b"NaN"), "not_a_number", column="pt_psia"),
    Case("inf", by.field(7, "pt_psia", b"-inf"), "not_a_number", column="pt_psia"),
    Case("1e999", by.field(7, "mach", b"1e999"), "not_a_number", column="mach"),
    Case("decimal comma in quotes", by.field(7, "mach", b'"0,84"'), "not_a_number", column="mach"),
    Case("unknown phase code", by.field(7, "phase_code", b"=cmd()"), "unknown_phase", column="phase_code"),
    Case("no airport", lambda c: by.joined([[*x, b"LOWW" if i else b"origin", b"<b>" if i else b"destination"]
         for i, x in enumerate(by.fields_of(c))]), "unknown_airport", N, column="destination"),
    # units
    Case("kelvin for degrees", by.column(("tat_degc", "hx_in_degc", "hx_out_degc", "cc_in_degc"), lambda v: v + 273.15),
         "unit_kelvin", N, 0, "tat_degc"),
    Case("kPa for psia", by.column(("pt_psia", "cc_in_psia", "cc_out_psia"), lambda v: v * 6.894757),
         "unit_kpa", N, 0, "pt_psia"),
    Case("kg/s for lb/min", by.column(("pack_flow_lbpm", "cc_flow_lbpm"), lambda v: v * 0.45359237 / 60),
         "unit_kg_s", N, 0, "pack_flow_lbpm"),
    Case("metres for feet", by.column("altitude_ft", lambda v: v * 0.3048), "wrong_unit", N, 0, "altitude_ft"),
    Case("an altimeter that reads too much", by.column("altitude_ft", lambda v: v + 9000), "implausible_pressure",
         column="altitude_ft"),
    Case("rad/s for rpm", by.column("cc_speed_rpm", lambda v: v * 0.10472), "wrong_unit", N, 0, "cc_speed_rpm"),
    Case("inlet and exit swapped", by.exchanged("hx_in_degc", "hx_out_degc"), "swapped_columns", N, 0,
         "hx_in_degc, hx_out_degc"),
    Case("a flight of 1900", lambda c: c.replace(b"2024", b"1900"), "too_early", N, 0, "flight_id",
         path="AQX/LX-AAA/acms/LX-AAA_19000525_04.csv"),
    Case("dead flow sensor is no slip of units", by.column("pack_flow_lbpm", lambda v: (v * 7) % 3 - 0.5), None),
    Case("pack switched off is no slip of units",
         by.column(("pack_flow_lbpm", "cc_flow_lbpm", "cc_speed_rpm"), lambda v: 0.5 + 0.01 * (v % 7)), None),
    # sensors: stored as recorded, judged flight by flight afterwards
    Case("sensor stuck at the end of its range", by.column("hx_in_degc", lambda v: 300.0), None),
    Case("drifting sensor", by.column("hx_out_degc", lambda v: v + 8.0), None),
    Case("spike within what can be", by.field(9, "altitude_ft", b"43000.0"), None),
    Case("value missing", by.field(9, "altitude_ft", b""), None),
    # times
    Case("time missing", by.retimed(lambda t: ""), "unreadable_time", N, 0, "report_time"),
    Case("no such day", by.retimed(lambda t: "2023-02-29" + t[10:]), "unreadable_time", N, 0, "report_time"),
    Case("clock reset", by.retimed(lambda t: "1970-01-01" + t[10:]), "time_contradicts_flight_id", N, 0, "report_time"),
    Case("local time with its offset", by.retimed(lambda t: t[:-1] + "+02:00"), None),
    Case("time without zone", by.retimed(lambda t: t[:-1]), "time_without_zone", column="report_time"),
    Case("fractions of a second", by.retimed(lambda t: t[:-1] + ".250Z"), None),
    Case("clock jumps on the way", lambda c: c[:3000] + by.retimed(lambda t: "2024-05-26T23" + t[13:])(c[3000:]),
         "clock_jump", column="report_time"),
    Case("two legs under one flight_id", lambda c: c + b"".join(later(c, hours=3).splitlines(keepends=True)[1:]),
         "two_legs", n_stored=2 * N, column="report_time"),
    Case("clock runs backwards, rows out of order", lambda c: by.joined([(x := by.fields_of(c))[0], *x[:0:-1]]), None),
    # identity
    Case("flight_id of no such day", lambda c: c.replace(b"_20240525_", b"_20240532_"), "bad_flight_id", N, 0),
    Case("flight_id of another file", lambda c: c.replace(b"_04,", b"_05,"), "flight_id_contradicts_path", N, 0),
    Case("pack 1.5", by.field(3, "pack", b"1.5"), "bad_pack", n_stored=N - 1, column="pack"),
    Case("packs from 0", by.column("pack", lambda v: v - 1), "bad_pack", N, 0, "pack"),
    Case("pack missing", by.field(3, "pack", b""), "bad_pack", n_stored=N - 1, column="pack"),
    Case("a copy by another name", lambda c: c, "flight_id_from_column", path=f"AQX/LX-AAA/acms/{FLIGHT} (1).csv"),
    # Parquet
    Case("good history", by.parquet, None, path=HISTORY),
    Case("a copy of history by another name", by.parquet, "flight_id_from_column",
         path="AQX/LX-AAA/acms/history (1).parquet"),
    Case("a note on a field that is not UTF-8", by.annotated, None, path=HISTORY),
    Case("numbers as wide decimals", by.decimals, None, path=HISTORY),
    Case("a time no calendar has", by.timed("ms", "UTC", [2**63 - 1] + [None] * (N - 1)), "unreadable_time",
         n_stored=N - 1, column="report_time", path=HISTORY),
    Case("a time no calendar has, before it", by.timed("us", "Europe/Berlin", [-(2**62)] + [None] * (N - 1)),
         "unreadable_time", n_stored=N - 1, column="report_time", path=HISTORY),
    Case("times of a zone by its offset", by.timed("us", "+05:30", [None] * N), None, path=HISTORY),
    Case("times of a zone nobody knows", by.timed("ms", "Mars/Phobos", [None] * N), None, path=HISTORY),
    Case("history cut short", lambda c: by.parquet(c)[:-100], "cannot_read_parquet", n_stored=0, path=HISTORY),
    Case("history with a bit flipped", by.flip, "cannot_read_parquet", n_stored=0, path=HISTORY),
    Case("text under the name of Parquet", lambda c: c, "cannot_read_parquet", n_stored=0, path=HISTORY),
    Case("history without rows", lambda c: by.parquet(c, pl.DataFrame.clear), "no_rows", n_stored=0, path=HISTORY),
    Case("column renamed in history", lambda c: by.parquet(c, lambda f: f.rename({"hx_in_degc": "T_HX_IN"})),
         "missing_columns", n_stored=0, column="hx_in_degc", path=HISTORY),
    Case("numbers as text", by.retyped(pl.col("mach", "pack", "report_time").cast(pl.String)), None, path=HISTORY),
    Case("numbers as integers", by.retyped(pl.col("altitude_ft", "vda_pos").cast(pl.Int64)), None, path=HISTORY),
    Case("numbers retyped as lists", by.retyped(pl.concat_list("mach")), "wrong_type", n_stored=0, column="mach",
         path=HISTORY),
    Case("times retyped as counts", by.retyped(pl.col("report_time").dt.epoch()), "wrong_type", n_stored=0,
         column="report_time", path=HISTORY),
    Case("times in nanoseconds without zone",
         by.retyped(pl.col("report_time").dt.replace_time_zone(None).dt.cast_time_unit("ns")), "time_without_zone",
         path=HISTORY),
    Case("NaN for missing", by.retyped(pl.lit(float("nan")).alias("hx_in_degc")), "not_a_number", n_entries=N,
         column="hx_in_degc", path=CPL),
    Case("text in a number column of history", by.retyped(pl.lit("ERR").alias("mach")), "not_a_number", n_entries=N,
         column="mach", path=HISTORY),
]  # fmt: skip


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
def test_class_of_bad_input(case, good_flight, deliver, read):
    intake = read(deliver({case.path: case.spoil(good_flight)}))
    faults = intake.quarantine
    assert intake.rows.height == case.n_stored
    assert set(faults["reason"]) == ({case.reason} if case.reason else set())
    if case.reason:
        scope = REASONS[case.reason].scope
        assert faults.height == case.n_entries
        assert faults.select("file", "scope").unique().rows() == [(case.path, scope)]
        assert (case.column or "") in (faults["column_name"][0] or "")
        assert scope not in ("row", "value") or faults["row"].null_count() == 0


@pytest.fixture
def good_rows(good_flight, deliver, read) -> pl.DataFrame:
    """Rows of the good flight."""
    return read(deliver({CSV: good_flight})).rows


def test_bad_value_costs_itself_alone(good_flight, good_rows, deliver, read):
    files = deliver({CSV: by.field(7, "hx_out_degc", b"ERR")(good_flight)})
    spoiled, good = (rows.filter(row_in_file=8) for rows in (read(files).rows, good_rows))
    assert spoiled["hx_out_k"].item() is None
    assert spoiled.drop("hx_out_k").equals(good.drop("hx_out_k"))


def test_bad_files_block_no_good_one(good_flight, good_rows, deliver, read):
    spoils = [c.spoil for c in CASES if c.path == CSV and c is not KEEP]
    bad = {f"AQX/LX-AAA/acms/BAD_{i}.csv": spoil(good_flight) for i, spoil in enumerate(spoils)}
    assert read(deliver({CSV: good_flight, **bad})).rows.filter(file=CSV).equals(good_rows)


@pytest.mark.parametrize(
    ("column", "value", "tolerance"),
    [
        ("altitude_m", 2616 * 0.3048, 1e-12),
        ("tat_k", 288.15, 1e-12),
        ("total_pressure_pa", 14.68 * 6.894757e3, 1e-7),
        ("ram_door_open", 0.215, 1e-12),
        ("pack_flow_kg_s", 116.5 * 7.559873e-3, 1e-6),
        ("cc_speed_rad_s", 12904 * 1.047198e-1, 1e-6),
    ],
)
def test_units_become_si(good_rows, column, value, tolerance):
    """Of 2616 ft, 15 degC, 14.68 psia, 21.5 %, 116.5 lb/min, 12904 rpm, by the factors of NIST SP 811."""
    assert good_rows[column][0] == pytest.approx(value, rel=tolerance)


def test_local_time_becomes_utc(good_flight, good_rows, deliver, read):
    shifted = read(deliver({CSV: by.retimed(lambda t: t[:-1] + "+02:00")(good_flight)})).rows["time_utc"]
    assert (good_rows["time_utc"] - shifted == timedelta(hours=2)).all()


def test_history_repeats_the_csv(good_flight, deliver, read):
    files = deliver({CSV: good_flight, HISTORY: by.parquet(good_flight)})
    merged = merge_deliveries([read(files).rows], {})
    assert (merged.rows.height, merged.duplicates["n_duplicate"].sum()) == (N, N)
    assert merged.quarantine.is_empty()


def test_leap_day_is_taken_in(good_flight, deliver, read):
    content = good_flight.replace(b"20240525", b"20240229").replace(b"2024-05-25", b"2024-02-29")
    content = content.replace(b"2024-05-26", b"2024-03-01")
    intake = read(deliver({"AQX/LX-AAA/acms/LX-AAA_20240229_04.csv": content}))
    assert (intake.rows.height, intake.quarantine.height) == (N, 0)


def test_tail_of_another_operator_is_noted(good_flight, deliver, read):
    intake = read(deliver({"fleet.csv": b"operator,tail,packs\nBZR,LX-AAA,2\n", CSV: good_flight}))
    assert intake.rows.height == N
    assert intake.quarantine["reason"].to_list() == ["unknown_tail"]
    assert "BZR" in intake.quarantine["detail"].item()


def test_vanished_file_is_noted(good_flight, deliver, read):
    files = deliver({CSV: good_flight})
    Path(files[0].full_path).unlink()
    assert read(files).quarantine["reason"].to_list() == ["cannot_open"]


def test_excess_faulty_values_are_counted(good_flight, deliver, read):
    many = good_flight + b"".join(good_flight.splitlines(keepends=True)[1:] * 5)
    faults = read(deliver({CSV: by.column("mach", lambda v: 9.9)(many)})).quarantine
    (excess,) = faults.filter(pl.col("row").is_null())["detail"]
    assert faults.height == 101
    assert "152 more" in excess


ROOT = Path(__file__).parents[3]


def test_every_reason_has_a_test():
    folders = (ROOT / name for name in ("tests/pipelines", "tests/hdt_core/record", "extensions/tests"))
    source = "".join(p.read_text() for folder in folders for p in folder.glob("**/test_*.py"))
    assert [r for r in REASONS if f'"{r}"' not in source] == []


def test_every_reason_is_documented():
    page = (ROOT / "docs/bad-input.md").read_text()
    rows = [f"| `{code}` | {r.scope} | {r.sentence} | {r.remedy} |" for code, r in REASONS.items()]
    assert [line for line in page.splitlines() if line.startswith("| `")] == rows


def test_empty_flight_id_has_one_message(good_flight, deliver, read):
    """Whatever else the file holds."""
    empty = by.field(7, "flight_id", b"")(good_flight)
    details = [
        read(deliver({CSV: content})).quarantine.filter(reason="bad_flight_id")["detail"].to_list()
        for content in (empty, by.line_as(3, b"x")(empty), by.field(7, "flight_id", b'""')(good_flight))
    ]
    assert details == [[REASONS["bad_flight_id"].sentence]] * 3
