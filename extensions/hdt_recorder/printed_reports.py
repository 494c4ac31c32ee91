"""Heads of an aircraft's printed ACMS reports: bleed and pack state at one time."""

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path

import polars as pl

from hdt_core.tables.raw import RawReports
from hdt_recorder.decoding.layout import MapError
from hdt_recorder.decoding.printed import Layout, LayoutError, ReportLine, read_layouts, read_reports
from hdt_recorder.decoding.report_layouts import A330, ReportHead, report_heads
from hdt_recorder.recordings import MOST_BYTES, read_recording, unpacked_bytes
from hdt_recorder.types_of_zone import types_of
from pipelines.intake.columns import SIGNAL_COLUMNS
from pipelines.intake.faults import Fault
from pipelines.intake.landing_file import FileIntake, LandingFile
from pipelines.intake.logs import printable, time_fault

MESSAGE_FILE = "message.dat"
"""Name of the message file in a recorder's archive."""
(_FOOT_M,) = (c.scale for c in SIGNAL_COLUMNS if c.name == "altitude_ft")


def read_printed(file: LandingFile, now: datetime, version: str) -> FileIntake:
    """Read the heads of a file's reports into the columns of `raw_reports`, each once.

    A row of the account is a report. Damage below its head is reported and rejects nothing.

    Parameters
    ----------
    now : datetime
        Times after it lie in the future. UTC.
    version : str
        Of the file, to be kept beside the rows.
    """
    path = Path(file.full_path)
    if unpacked_bytes(path) > MOST_BYTES:
        return _log(file, [], [Fault("too_large")])
    try:
        content = read_recording(path, MESSAGE_FILE).tobytes()
        reports = read_reports(content, _layouts(file))
    except (OSError, MapError, LayoutError) as error:
        reason = "bad_type" if isinstance(error, LayoutError) else "no_report"
        return _log(file, [], [Fault(reason, detail=f"{error}.")])
    faults = [
        Fault("damaged_line", r.line, None, f"{printable(r.reason)}.", content=printable(r.text))
        for r in reports.rejected
    ]
    faults += [Fault("unknown_report", detail=f"{printable(title)}.") for title in dict.fromkeys(reports.undeclared)]
    heads = list(report_heads(reports))
    results = [_report_row(head, file, now) for head in heads]
    valid = [j for j in results if not isinstance(j, Fault)]
    distinct = list(dict.fromkeys(valid))
    head_faults = [j for j in results if isinstance(j, Fault)]
    if not heads:
        faults.append(Fault("no_report"))
    rows = [(*row, file.path, version) for row in distinct]
    return _log(file, rows, faults + head_faults, len(heads), len(valid) - len(distinct))


def _layouts(file: LandingFile) -> Mapping[str, Layout]:
    """Return the layouts that the aircraft's type names; else those of the A330."""
    kind = types_of(Path(file.landing)).of(file.operator, file.tail)
    layout_file = kind.reports_file if kind else None
    if layout_file is None:
        return A330
    try:
        return read_layouts(layout_file.read_text("utf-8"))
    except (LayoutError, UnicodeDecodeError) as error:
        raise LayoutError(f"{layout_file.name}: {error}") from None


def _report_row(head: ReportHead | ReportLine, file: LandingFile, now: datetime) -> tuple[object, ...] | Fault:
    """Return a row without file and version, or why the report is rejected."""
    if isinstance(head, ReportLine):
        return Fault("report_without_head", head.line, detail=f"Report <{head.number}>.", n_rows=1)
    detail = f"<{head.number}> of {head.printed_at:%Y-%m-%d %H:%M:%S}"
    if head.aircraft != file.tail:
        detail += f" is of {printable(head.aircraft) or 'no aircraft'}."
        return Fault("other_aircraft", head.line, "acid", detail, 1)
    if fault := time_fault(head.printed_at, now, "date, utc"):
        return Fault(fault.reason, head.line, fault.column_name, f"{detail}.", 1)
    altitude_m = None if head.altitude_ft is None else head.altitude_ft * _FOOT_M
    return (file.operator, file.tail, head.printed_at, head.number, altitude_m, head.mach, *head.pack_flow_kg_s,
            *head.bleed_open, head.crossfeed_open)  # fmt: skip


def _log(
    file: LandingFile, rows: list[tuple[object, ...]], faults: list[Fault], n_delivered: int = 0, n_duplicate: int = 0
) -> FileIntake:
    frame = pl.DataFrame(rows, schema=dict(RawReports.create_empty().schema), orient="row")
    return FileIntake(frame, file.quarantine(faults), n_delivered, n_duplicate)
