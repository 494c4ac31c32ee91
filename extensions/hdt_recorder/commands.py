"""Commands that read flight recorders: list, decode and reports."""

import difflib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipelines.cli.base import AsJson, StopError, app, out

if TYPE_CHECKING:
    from hdt_recorder.decoding.layout import Damage, Parameter

recorder = typer.Typer(no_args_is_help=True, help="Read a flight recorder's file: ARINC 717 or ARINC 767.")
app.add_typer(recorder, name="recorder")

Recording = Annotated[Path, typer.Argument(metavar="FILE", help="Recording, or an archive whose largest file is one.")]
MapFile = Annotated[Path, typer.Option("--map", help="Parameter map: .vec, ARINC 647A XML, or our TOML or CSV.")]


@recorder.command("list")
def list_parameters(file: Recording, map_file: MapFile, as_json: AsJson = False) -> None:
    """List a recording's parameters with unit and values a second.

    Reports damage too. For a map that does not fit the recording, reports what disagrees.
    """
    from hdt_recorder.recordings import open_recording

    with _one_line():
        recording, layout = open_recording(file, map_file)
    if as_json:
        parameters = [_row(p) for p in layout.parameters.values()]
        out.print_json(json.dumps({"damage": asdict(recording.damage), "parameters": parameters}))
        return
    width = max((len(n) for n in layout.parameters), default=0)
    for row in map(_row, layout.parameters.values()):
        note = f"no value: {row['unreadable']}" if row["unreadable"] else row["description"]
        line = f"{row['parameter']:{width}}  {row['unit']:8}  {row['rate_hz']:7.4g} Hz  {note}"
        out.print(line.rstrip(), markup=False, soft_wrap=True)
    out.print(f"{len(layout.parameters)} parameters. {_damage_line(recording.damage)}", soft_wrap=True)


@recorder.command("decode")
def decode_parameters(
    file: Recording,
    map_file: MapFile,
    target: Annotated[Path, typer.Option("--out", help="Parquet file: parameter, t_s, value, text.")],
    parameter: Annotated[
        list[str] | None, typer.Option(help="Only this parameter; may be given more than once.")
    ] = None,
) -> None:
    """Write a recording's parameters as Parquet.

    Values of damaged frames are null, and counted.
    """
    from hdt_recorder.recordings import open_recording, write_decoded

    with _one_line():
        recording, layout = open_recording(file, map_file)
        selection = (
            [_parameter(layout.parameters, name) for name in parameter] if parameter else layout.parameters.values()
        )
        result = write_decoded(recording, selection, target)
    summary = f"{result.parameters} parameters, {result.rows:,} values, {result.nulls:,} of them null: {target}"
    out.print(summary, soft_wrap=True)
    out.print(_damage_line(recording.damage), soft_wrap=True)
    if not parameter and (n_unreadable := sum(bool(p.unreadable) for p in layout.parameters.values())):
        out.print(f"{n_unreadable} parameters have no value; `hdt recorder list` says why.", soft_wrap=True)


@recorder.command("reports")
def read_printed(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Message file or text; of an archive, message.dat.")],
    layouts: Annotated[Path | None, typer.Option(help="Layouts of reports; else those of the A330.")] = None,
    target: Annotated[
        Path | None, typer.Option("--out", help="Parquet file: report, number, line, row, name, value, text.")
    ] = None,
) -> None:
    """Read the printed ACMS reports of a recorder's message file.

    Lines that do not match their layout are reported with number and reason.
    """
    from hdt_recorder.decoding.printed import read_layouts, read_reports
    from hdt_recorder.decoding.report_layouts import A330
    from hdt_recorder.recordings import read_recording, report_rows
    from pipelines.storage.files import replacing

    with _one_line():
        by_number = read_layouts(layouts.read_text("utf-8")) if layouts else A330
        reports = read_reports(read_recording(file, "message.dat").tobytes(), by_number)
        if target:
            with replacing(target) as temporary:
                report_rows(reports.lines).write_parquet(temporary)
    for number in sorted({x.number for x in reports.lines}):
        lines = [x for x in reports.lines if x.number == number]
        count = len({x.report for x in lines})
        out.print(
            f"<{number}> {by_number[number].title}: {count} reports, {len(lines)} lines", markup=False, soft_wrap=True
        )
    for title in dict.fromkeys(reports.undeclared):
        out.print(f"no layout: {title}", markup=False, soft_wrap=True)
    for r in reports.rejected:
        out.print(f"line {r.line}: {r.reason}: {ascii(r.text[:80])[1:-1]}", markup=False, soft_wrap=True)


@contextmanager
def _one_line() -> Iterator[None]:
    from hdt_recorder.decoding.layout import MapError
    from hdt_recorder.decoding.printed import LayoutError

    try:
        yield
    except (MapError, LayoutError, FileExistsError) as error:
        raise StopError(str(error)) from None
    except UnicodeDecodeError:
        raise StopError("the layouts are no text in UTF-8") from None


def _parameter(parameters: Mapping[str, "Parameter"], name: str) -> "Parameter":
    if name not in parameters:
        near = ", ".join(difflib.get_close_matches(name.upper(), parameters, 3))
        raise StopError(f"no parameter {name}; {f'near are {near}' if near else '`hdt recorder list` has them'}")
    if reason := parameters[name].unreadable:
        raise StopError(f"{name} has no value: {reason}")
    return parameters[name]


def _row(p: "Parameter") -> dict[str, object]:
    return {
        "parameter": p.name, "unit": p.unit, "rate_hz": p.rate_hz, "kind": p.coding.kind,
        "description": p.description, "unreadable": p.unreadable,
    }  # fmt: skip


def _damage_line(damage: "Damage") -> str:
    counts = asdict(damage)
    unit = counts.pop("unit")
    return f"{unit.capitalize()}: " + ", ".join(f"{n:,} {k.replace('_', ' ')}" for k, n in counts.items()) + "."
