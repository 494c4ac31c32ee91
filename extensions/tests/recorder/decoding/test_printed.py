"""Printed reports: read by their declared layouts, and set aside by line and reason where they are damaged."""

import numpy as np
import pytest
from recordings import message_file

from hdt_recorder.decoding.printed import LayoutError, read_layouts, read_reports
from hdt_recorder.decoding.report_layouts import A330

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


def test_a_report_says_what_its_layout_declares():
    result = read(OTHER, REPORT, REPORT)
    assert result.rejected == ()
    assert result.undeclared == ("A999 DOOR REPORT(TST)",)
    assert [(x.report, x.row) for x in result.lines[:7]] == [
        (1, r) for r in ("C1", "N1", "N2", "S1", "S2", "E1", "REASON:")
    ]
    assert {x.report for x in result.lines} == {1, 2}
    values = {x.row: x.values for x in result.lines}
    assert values["C1"] == {"acid": ".X-ABCD", "date": "05MAR26", "flight": "TST1234"}
    assert values["N1"] == {"flow": 1.31, "outlet": 12.5, "valve": "11"}
    assert values["N2"] == {"flow": None, "outlet": -3.0, "valve": "1X"}
    assert values["E1"] == {"utc": "12.30.05", "max": 101.5}
    assert values["REASON:"] == {"reason": "NOT CLOSED IN TIME"}


def test_plain_text_is_read_as_a_file_of_blocks_is():
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
def test_a_damaged_line_is_set_aside_with_its_reason_and_costs_no_other(change, reason):
    assert change[0] in REPORT
    damaged = REPORT.replace(*change)
    result = read(damaged)
    (rejected,) = result.rejected
    assert reason in rejected.reason
    assert damaged.splitlines()[rejected.line - 1].startswith(rejected.text[:5])
    assert len(result.lines) == 6


def test_a_message_that_lost_characters_is_told():
    data = message_file(REPORT, REPORT)
    at = data.index(b"   ACID")
    result = read_reports(data[:at] + data[at + 3 :], LAYOUTS)
    assert any("characters, by its end" in r.reason for r in result.rejected)


def test_three_hundred_damaged_files_are_read_or_set_aside():
    whole = {(x.row, tuple(x.values.values())) for x in read(REPORT).lines}
    data = message_file(*[REPORT] * 4)
    n_intact = 0
    for seed in range(300):
        rng = np.random.default_rng(seed)
        damaged = bytearray(data)
        for _ in range(rng.integers(1, 6)):
            at, size = int(rng.integers(len(damaged))), int(rng.integers(1, 60))
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
def test_a_layout_that_cannot_be_read_says_where(text, message):
    with pytest.raises(LayoutError, match=message):
        read_layouts(text)


def test_the_seven_layouts_are_short():
    """A new report is a declaration of twenty lines or less."""
    assert set(A330) == {"08", "10", "13", "15", "18", "37", "50"}
    common = 4
    assert max(len(layout.lines) - common for layout in A330.values()) <= 20
