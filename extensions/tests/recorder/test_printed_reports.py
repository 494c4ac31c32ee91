"""Printed reports: read by their declared layouts, heads become rows, damage is told by line, nothing is read twice."""

import zipfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from nights import run
from recordings import message_file, printed_report

import hdt_recorder.reader
from hdt_recorder.decoding.printed import LayoutError, read_layouts, read_reports
from hdt_recorder.decoding.report_layouts import A330
from hdt_recorder.printed_reports import read_printed
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import FileIntake, LandingFile
from pipelines.storage.catalog import connect

AT = datetime(2026, 3, 5, 12, 30, 5, tzinfo=UTC)
NOW = datetime(2026, 6, 1, tzinfo=UTC)
GOOD = printed_report("X-1", AT, 31_000)


def delivered(folder: Path, content: bytes, name: str = "message.dat") -> LandingFile:
    """The file as the landing zone lists it."""
    file = folder / "AAA/X-1/reports" / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    return next(f for f in list_landing(folder).files if f.path.endswith(name))


def balances(log: FileIntake) -> bool:
    return log.n_delivered == log.rows.height + log.n_duplicate + int(log.quarantine["n_rows"].sum())


def test_head_becomes_one_row(tmp_path):
    """A repeated one is counted as a duplicate."""
    other = printed_report("X-1", AT.replace(hour=13), 5_000, "-.-- 111 -- X 01 111 0.00")
    log = read_printed(delivered(tmp_path, message_file(GOOD, other, GOOD)), NOW, "v")
    columns = ("pack_1_flow_kg_s", "pack_2_flow_kg_s", "bleed_1_open", "bleed_2_open", "crossfeed_open")
    first, second = log.rows.select(columns).rows()
    assert log.rows.select("reported_at", "altitude_m", "mach").row(0) == (AT, pytest.approx(9448.8), 0.801)
    assert first == (1.2, 1.2, True, True, False)
    assert second == (None, 0.0, None, True, None)
    assert (log.n_delivered, log.n_duplicate) == (3, 1)
    assert balances(log)
    assert log.quarantine.is_empty()


DAMAGE = {
    "other_aircraft": ("C1 .X-1", "C1 .X-2"),
    "report_without_head": ("05MAR26 12.30.05", "05MAR26 12.61.05"),
    "future_time": ("05MAR26", "05JUL26"),
    "damaged_line": ("0.801 11-", "0.8x1 11-"),
    "no_report": ("REPORT <08>", "SURVEY"),
}


@pytest.mark.parametrize("reason", DAMAGE)
def test_damage_costs_no_other_report(tmp_path, reason):
    assert DAMAGE[reason][0] in GOOD
    bad = GOOD.replace(*DAMAGE[reason])
    texts = (bad,) if reason == "no_report" else (bad, GOOD.replace("12.30", "14.30"))
    log = read_printed(delivered(tmp_path, message_file(*texts)), NOW, "v")
    by_reason = {r["reason"]: r for r in log.quarantine.rows(named=True)}
    assert reason in by_reason
    assert balances(log)
    assert AT.replace(hour=14) in log.rows["reported_at"].to_list() or reason == "no_report"
    if reason != "no_report":
        assert "\n".join(texts).splitlines()[by_reason[reason]["row"] - 1][:2] in {"C1", "C3"}


def test_archive_is_read_by_message_file(tmp_path):
    file = delivered(tmp_path, b"", "LX_1.zip")
    with zipfile.ZipFile(file.full_path, "w") as archive:
        archive.writestr("raw.dat", bytes(200_000))
        archive.writestr("message.dat", message_file(GOOD))
    assert read_printed(file, NOW, "v").rows.height == 1


@pytest.fixture
def survey(tmp_path):
    """A printed report by a type's own layouts."""
    (tmp_path / "types").mkdir()
    (tmp_path / "fleet.csv").write_text("operator,tail,packs,type\nAAA,X-1,2,MINE\n")
    description = 'type = "MINE"\nmap = "m.toml"\nreports = "mine.reports"\n[component.HXT]\ntat_degc = "TAT"\n'
    (tmp_path / "types/mine.toml").write_text(description)
    layouts = "<**>\nC1 {acid:s} {date:7s} {utc:8s} {alt:5} {bleed_1:1}\n<91> PACK SURVEY\nN1 {flow:4}\n"
    (tmp_path / "types/mine.reports").write_text(layouts)
    text = "  A999 PACK SURVEY REPORT <91>   PAGE 01 OF 01\n\nC1 .X-1 05MAR26 12.30.05 31000 0\n"
    return delivered(tmp_path, text.encode(), "survey.txt")


def test_type_brings_own_layouts(survey):
    (row,) = read_printed(survey, NOW, "v").rows.rows(named=True)
    assert (row["report"], row["bleed_1_open"], row["bleed_2_open"]) == ("91", False, None)


def test_bad_layout_of_type_names_line(survey, tmp_path):
    (tmp_path / "types/mine.reports").write_text("C1 {acid:s}\n")
    log = read_printed(survey, NOW, "v")
    assert "mine.reports: line 1: a report begins with" in log.quarantine["detail"][0]


def test_stored_file_is_read_once(tmp_path, monkeypatch):
    landing = tmp_path / "landing"
    read_files = []

    def watched(file: LandingFile, now: datetime, version: str) -> FileIntake:
        read_files.append(file.name)
        return read_printed(file, now, version)

    monkeypatch.setattr(hdt_recorder.reader, "read_printed", watched)
    first = delivered(landing, message_file(GOOD), "one.dat")
    (landing / "fleet.csv").write_text("operator,tail,packs\nAAA,X-1,2\n")
    run(landing, tmp_path / "home")
    delivered(landing, message_file(GOOD.replace("12.30", "14.30")), "two.dat")
    run(landing, tmp_path / "home")
    assert read_files == ["one.dat", "two.dat"]
    Path(first.full_path).unlink()
    delivered(landing, message_file(GOOD.replace("12.30", "15.30")), "two.dat")
    run(landing, tmp_path / "home")
    assert read_files == ["one.dat", "two.dat", "two.dat"]
    with connect(tmp_path / "home") as con:
        assert con.sql("select reported_at from reports order by 1").fetchall() == [(AT,), (AT.replace(hour=15),)]


PACK = """
<**>
C1 {acid:s} {date:7s} {flight:s}
<91> PACK SURVEY
N1|N2 {flow:4} {outlet:5} {valve:2s}
S. {speed:5} {ratio:4}
E1 UTC: {utc:8s} MAX : {max}
 REASON:{reason:t}
"""
LAYOUTS = read_layouts(PACK)
REPORT = """
               A999 PACK SURVEY REPORT <91>       PAGE 01 OF 02

   ACID    DATE    FLT
C1 .X-ABCD 05MAR26 TST1234

   FLOW OUTL  VALVE
N1 1.31 012.5 11
N2 -.-- -03.0 1X

   SPEED RATIO
S1 38210 2.11
S2 38190 2.10

               A999 PACK SURVEY REPORT <91>       PAGE 02 OF 02

E1 UTC: 12.30.05  MAX : 101.5
   REASON:NOT CLOSED IN TIME
"""
OTHER = """
     A999 DOOR REPORT(TST)

OPP  02   1426
"""


def read(*texts: str):
    return read_reports(message_file(*texts), LAYOUTS)


def test_report_follows_its_layout():
    values = {x.row: x.values for x in read(REPORT).lines}
    assert values == values | {
        "C1": {"acid": ".X-ABCD", "date": "05MAR26", "flight": "TST1234"},
        "N1": {"flow": 1.31, "outlet": 12.5, "valve": "11"},
        "N2": {"flow": None, "outlet": -3.0, "valve": "1X"},
        "E1": {"utc": "12.30.05", "max": 101.5},
        "REASON:": {"reason": "NOT CLOSED IN TIME"},
    }


def test_reports_are_told_apart():
    result = read(OTHER, REPORT, REPORT)
    assert result.rejected == ()
    assert result.undeclared == ("A999 DOOR REPORT(TST)",)
    rows = ("C1", "N1", "N2", "S1", "S2", "E1", "REASON:")
    assert [(x.report, x.row) for x in result.lines] == [(n, r) for n in (1, 2) for r in rows]


def test_plain_text_is_read_alike():
    plain = read_reports(REPORT.encode(), LAYOUTS)
    assert [x.values for x in plain.lines] == [x.values for x in read(REPORT).lines]
    assert REPORT.splitlines()[plain.lines[1].line - 1].startswith("N1")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("N1 1.31 012.5 11", "N1 1.31 12.5 11"), "outlet is '12.5', not as wide as its layout has it"),
        (("N1 1.31 012.5 11", "N1 1.31 012.5"), "3 words, by its layout 4: flow outlet valve"),
        (("N1 1.31 012.5 11", "N1 1.31 01x.5 11"), "outlet is '01x.5', no number"),
        (("N1 1.31 012.5 11", "NQ 1.31 012.5 11"), "no line of <91> begins with NQ"),
        (("E1 UTC: 12.30.05", "E1 UTD: 12.30.05"), "it is 'UTD:', not as wide"),
    ],
)
def test_damaged_line_costs_no_other(change, reason):
    assert change[0] in REPORT
    damaged = REPORT.replace(*change)
    result = read(damaged)
    (rejected,) = result.rejected
    assert reason in rejected.reason
    assert damaged.splitlines()[rejected.line - 1].startswith(rejected.text[:5])
    assert len(result.lines) == 6


def test_shortened_message_is_rejected():
    data = message_file(REPORT, REPORT)
    at = data.index(b"   ACID")
    result = read_reports(data[:at] + data[at + 3 :], LAYOUTS)
    assert any("characters, by its end" in r.reason for r in result.rejected)


def test_damaged_files_invent_no_numbers():
    whole = {(x.row, tuple(x.values.values())) for x in read(REPORT).lines}
    data = message_file(*[REPORT] * 4)
    n_intact = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        damaged = bytearray(data)
        for _ in range(rng.integers(1, 6)):
            at = int(rng.integers(len(damaged)))
            size = int(rng.integers(1, 60))
            damaged[at : at + size] = b"" if rng.integers(2) else rng.integers(128, 256, size, np.uint8).tobytes()
        result = read_reports(bytes(damaged[: int(rng.integers(len(data) // 2, len(data) + 1))]), LAYOUTS)
        n_intact += sum((x.row, tuple(x.values.values())) in whole for x in result.lines)
        numbers = [v for x in result.lines for n, v in x.values.items() if n in {"flow", "outlet", "speed", "ratio"}]
        assert all(v is None or np.isfinite(v) for v in numbers)
    assert n_intact > 300 * 7


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("N1 {a}", "line 1: a report begins with"),
        ("<91> X\nN1 nothing", "line 2: fields are"),
        ("<91> X\nN1 {a} {a}", "line 2: fields are"),
        ("<91> X\nN1 {a:x}", "line 2: fields are"),
    ],
)
def test_unreadable_layout_names_line(text, message):
    with pytest.raises(LayoutError, match=message):
        read_layouts(text)


def test_seven_layouts_are_short():
    """A new report is a declaration of twenty lines or less."""
    assert set(A330) == {"08", "10", "13", "15", "18", "37", "50"}
    common = 4
    assert max(len(layout.lines) - common for layout in A330.values()) <= 20
