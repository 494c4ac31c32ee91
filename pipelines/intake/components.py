"""Read files of declared components into validated rows in SI, one a flight, pack, time and signal."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from hdt_core.components import Channel, Component, recorded_components
from hdt_core.tables.components import COMPONENT_FLIGHT_ID
from pipelines.intake.columns import Contract
from pipelines.intake.faults import Fault, limit_values, quarantine
from pipelines.intake.header import match_header
from pipelines.intake.landing_file import RECORDER, LandingFile
from pipelines.intake.names import EARLIEST, MAX_PACKS
from pipelines.intake.parquet import open_parquet
from pipelines.intake.readers import readers
from pipelines.intake.text import Text, open_text
from pipelines.intake.text_columns import to_columns
from pipelines.intake.times import to_utc, zone_note
from pipelines.storage.panics import first_line, panics_as_errors

REQUIRED = ("flight_id", "report_time")
FLIGHT = ["operator", "tail", "component", "flight_id"]
KEY = [*FLIGHT, "pack", "time_utc"]
SCHEMA = {
    "operator": pl.String(), "tail": pl.String(), "flight_id": pl.String(), "pack": pl.Int32(),
    "component": pl.String(), "time_utc": pl.Datetime("us", "UTC"), "signal": pl.String(), "value": pl.Float64(),
    "file": pl.String(),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ComponentIntake:
    """Result of one file: rows in long form (`SCHEMA`), quarantine rows, and the count of its lines."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    n_delivered: int
    n_loaded: int
    n_duplicate: int

    @property
    def n_good(self) -> int:
        """Lines that could be stored if there were no other delivery."""
        return self.n_loaded + self.n_duplicate + self.quarantine.filter(reason="conflicting_delivery").height


def read_components(files: Sequence[LandingFile], now: datetime) -> list[tuple[LandingFile, ComponentIntake]]:
    """Read each file, a recording once for each component, and choose among deliveries of one flight.

    Parameters
    ----------
    files : sequence of LandingFile
        Of one or several aircraft, all that hold a component of them.
    now : datetime
        Times after it lie in the future. UTC.

    Returns
    -------
    list of (LandingFile, ComponentIntake)
        In the order of `files`. Counts are of lines; each line is stored, quarantined or a duplicate. Never raises for
        the content of a file.
    """
    pairs = [(file, code) for file in files for code in _components_in(file)]
    parts = [_read_file(file, code, now) for file, code in pairs]
    keys = pl.DataFrame(schema={**{k: SCHEMA[k] for k in KEY}, "row": pl.Int64(), "index": pl.Int64()})
    frames = (_with_aircraft(part.rows, i, pairs[i][0]) for i, part in enumerate(parts))
    rows = pl.concat([keys, *frames], how="diagonal")
    rows_to_store = _choose_deliveries(rows)
    by_file, stored_by_file = (frame.partition_by("index", as_dict=True) for frame in (rows, rows_to_store))
    results = []
    for i, (file, _) in enumerate(pairs):
        rows, stored_rows = by_file.get((i,), rows.clear()), stored_by_file.get((i,), rows_to_store.clear())
        results.append((file, _intake_of(file, parts[i], rows, stored_rows, rows_to_store)))
    return results


@dataclass(slots=True)
class _OpenFile:
    """A file's rows, one column a signal, and its faults."""

    rows: pl.DataFrame
    faults: list[Fault]
    n_rows: int = 0


def _components_in(file: LandingFile) -> tuple[str, ...]:
    """List the folders of the components that a file describes: its own, or those of its aircraft's type."""
    if not file.is_recording:
        return (file.folder,)
    return readers()[RECORDER].components_in(file) if RECORDER in readers() else ()


def _read_file(file: LandingFile, folder: str, now: datetime) -> _OpenFile:
    component = recorded_components()[folder]
    try:
        with panics_as_errors():
            if file.is_recording:
                frame, n_rows, faults = readers()[RECORDER].rows(file, component.code)
                return _validate(frame, _OpenFile(pl.DataFrame(), faults, n_rows), None, component, now, MAX_PACKS)
            frame, text, open_file = _open_file(file, component)
            return _validate(frame, open_file, text, component, now, file.packs)
    except Exception as error:
        return _OpenFile(pl.DataFrame(), [Fault("cannot_process", detail=first_line(error))])


def _open_file(file: LandingFile, component: Component) -> tuple[pl.DataFrame, Text | None, _OpenFile]:
    """Read the known columns of a file in recorded units, `report_time` in UTC, `row` its line."""
    names = tuple(c.column for c in _channels(component))
    content, faults = file.read_content()
    if content is None:
        return pl.DataFrame(), None, _OpenFile(pl.DataFrame(), faults)
    if file.is_text:
        text = open_text(content, lambda faults_of_text: match_header(faults_of_text, REQUIRED, ("pack", *names)))
        frame, faults_of_text = to_columns([text], ("pack", *names))
        open_file = _OpenFile(pl.DataFrame(), [*text.faults, *faults_of_text[0]], text.n_rows)
    else:
        text = None
        frame, n_rows, faults = open_parquet(content, None, Contract(REQUIRED, (), ("pack", *names)))
        open_file = _OpenFile(pl.DataFrame(), faults, n_rows)
    if frame.height:
        frame, naive = to_utc(frame, "report_time")
        open_file.faults += zone_note(naive, "report_time")
    return frame, text, open_file


def _validate(
    frame: pl.DataFrame, open_file: _OpenFile, text: Text | None, component: Component, now: datetime, packs: int
) -> _OpenFile:
    """Select the rows that can be stored, in SI; the others and the values at fault become faults."""
    if frame.is_empty():
        return open_file
    if "pack" not in frame.columns:
        frame = frame.with_columns(pack=pl.lit(1.0))
    reasons = frame.select(_reason(now, packs).alias("reason"))["reason"]
    for row, reason in zip(frame["row"].filter(reasons.is_not_null()), reasons.drop_nulls(), strict=True):
        open_file.faults.append(Fault(reason, row, n_rows=1, content=text.line(row) if text else None))
    good = frame.filter(reasons.is_null())
    values, faults = _to_si(good, _channels(component))
    rejected_rows = {f.row for f in open_file.faults if f.n_rows}
    open_file.faults = [
        f for f in open_file.faults if f.reason != "not_a_number" or f.row not in rejected_rows
    ] + limit_values(faults)
    key = good.select(
        pl.lit(component.code).alias("component"),
        pl.col("flight_id").str.strip_chars(),
        pl.col("pack").cast(pl.Int32),
        pl.col("report_time").alias("time_utc"),
        "row",
    )
    return _OpenFile(key.hstack(values), open_file.faults, open_file.n_rows)


def _reason(now: datetime, packs: int) -> pl.Expr:
    """Give the reason why a row is rejected; null where it is not."""
    moment, pack = pl.col("report_time"), pl.col("pack")
    has_id = pl.col("flight_id").str.strip_chars().str.contains(COMPONENT_FLIGHT_ID)
    of_aircraft = (pack.is_between(1, packs) & (pack == pack.floor())).fill_null(False)
    return (
        pl.when(~has_id.fill_null(False)).then(pl.lit("bad_cycle_id"))
        .when(moment.is_null()).then(pl.lit("unreadable_time"))
        .when(moment < pl.lit(EARLIEST).cast(pl.Datetime("us", "UTC"))).then(pl.lit("too_early"))
        .when(moment > pl.lit(now).dt.cast_time_unit("us")).then(pl.lit("future_time"))
        .when(~of_aircraft).then(pl.lit("bad_pack"))
    )  # fmt: skip


def _to_si(rows: pl.DataFrame, channels: Sequence[Channel]) -> tuple[pl.DataFrame, list[Fault]]:
    """Convert signals to SI, null where the value is impossible; a fault for each such value."""
    columns, faults = [], []
    for channel in channels:
        values = rows[channel.column] if channel.column in rows.columns else pl.Series([None] * rows.height)
        value = values.cast(pl.Float64) * channel.scale + channel.offset
        strange = value.is_not_null() & ~value.is_finite()
        outside = value.is_finite() & ~value.is_between(channel.low, channel.high)
        for reason, bad in (("not_a_number", strange), ("out_of_range", outside)):
            bad_rows = rows.filter(bad.fill_null(False)).select("row", channel.column) if bad.any() else None
            rows_and_values = bad_rows.rows() if bad_rows is not None else []
            faults += [Fault(reason, row, channel.column, f"Found {v:g}.") for row, v in rows_and_values]
        columns.append(value.set((strange | outside).fill_null(False), None).alias(channel.signal))
    return pl.DataFrame(columns), faults


def _channels(component: Component) -> Sequence[Channel]:
    return component.record.channels if component.record else ()


def _with_aircraft(rows: pl.DataFrame, index: int, file: LandingFile) -> pl.DataFrame:
    """Add a file's aircraft to its rows: another's flights may have the same names."""
    keys = {**{k: SCHEMA[k] for k in KEY}, "row": pl.Int64()}
    frame = rows if rows.width else pl.DataFrame(schema=keys)
    return frame.with_columns(
        pl.lit(index, pl.Int64).alias("index"), operator=pl.lit(file.operator), tail=pl.lit(file.tail)
    )


def _choose_deliveries(wide: pl.DataFrame) -> pl.DataFrame:
    """Select the rows to store: of each flight those of one file, the one with most rows, then the last by name."""
    sizes = wide.group_by(*FLIGHT, "index").len().sort("len", "index", descending=True)
    first = sizes.unique(FLIGHT, keep="first", maintain_order=True).drop("len")
    own = wide.join(first, on=[*FLIGHT, "index"], how="semi").sort("index", "row")
    return own.unique([*KEY, "index"], keep="first", maintain_order=True)


def _intake_of(
    file: LandingFile, part: _OpenFile, rows: pl.DataFrame, own_stored: pl.DataFrame, all_stored: pl.DataFrame
) -> ComponentIntake:
    """Sort the rows of one file into stored rows, duplicates and conflicts with the rows stored of any file."""
    others = rows.join(own_stored.select("row"), on="row", how="anti")
    signals = [c for c in rows.columns if c not in (*KEY, "row", "index")]
    same = others.join(all_stored, on=[*KEY, *signals], how="semi", nulls_equal=True) if others.height else others
    differ = others.join(same.select("row"), on="row", how="anti")
    conflicts = [
        Fault("conflicting_delivery", row, detail="Another row of this flight and time is stored.", n_rows=1,
              flight_id=flight)
        for row, flight in differ.select("row", "flight_id").rows()
    ]  # fmt: skip
    long = own_stored.unpivot(signals, index=KEY, variable_name="signal", value_name="value").drop_nulls("value")
    long = long.with_columns(file=pl.lit(file.path)).select(pl.col(c).cast(t) for c, t in SCHEMA.items())
    quarantine_rows = quarantine(file.path, file.received_at, [*part.faults, *conflicts])
    return ComponentIntake(long, quarantine_rows, part.n_rows, own_stored.height, same.height)
