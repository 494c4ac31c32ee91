"""Read files of declared components into validated rows in SI, one a flight, pack, time and signal."""

from collections.abc import Sequence
from datetime import datetime

import polars as pl

from hdt_core.components import Channel, Component, recorded_components
from hdt_core.tables.base import COMPONENT_FLIGHT_ID
from hdt_core.tables.twin import RawComponents
from pipelines.intake.columns import Contract
from pipelines.intake.faults import Fault, first_line, panics_as_errors
from pipelines.intake.landing_file import EARLIEST, MAX_PACKS, RECORDER, FileIntake, LandingFile
from pipelines.intake.readers import readers
from pipelines.intake.row_validation import FROM_0, counts_from_0, in_future, is_pack
from pipelines.intake.snapshots import OpenFile, add_faults, open_files

FLIGHT = ["operator", "tail", "component", "flight_id"]
KEY = [*FLIGHT, "pack", "time_utc"]


def read_components(files: Sequence[LandingFile], now: datetime) -> list[tuple[LandingFile, FileIntake]]:
    """Read each file, a recording once for each component, and choose among deliveries of one flight.

    Parameters
    ----------
    files : sequence of LandingFile
        Of one or several aircraft, all that hold a component of them.
    now : datetime
        Times after it lie in the future. UTC.

    Returns
    -------
    list of (LandingFile, FileIntake)
        In the order of `files`. Counts are of lines; each line is stored, quarantined or a duplicate. Never raises for
        the content of a file.
    """
    pairs = [(file, folder) for file in files for folder in _components_in(file)]
    parts = [_read_file(file, folder, now) for file, folder in pairs]
    rows = pl.concat([_NO_ROWS, *(_with_aircraft(x, i, pairs[i][0]) for i, (x, _) in enumerate(parts))], how="diagonal")
    rows_to_store = _choose_deliveries(rows)
    by_file, stored_by_file = (frame.partition_by("index", as_dict=True) for frame in (rows, rows_to_store))
    results = []
    for i, (file, _) in enumerate(pairs):
        own = by_file.get((i,), rows.clear())
        own_stored = stored_by_file.get((i,), rows_to_store.clear())
        results.append((file, _intake_of(file, parts[i][1], own, own_stored, rows_to_store)))
    return results


_NO_ROWS = pl.DataFrame(
    schema={name: RawComponents.types()[name] for name in KEY} | {"row": pl.Int64, "index": pl.Int64}
)


def _components_in(file: LandingFile) -> tuple[str, ...]:
    """List the folders of the components that a file describes: its own, or those of its aircraft's type."""
    if not file.is_recording:
        return (file.folder,)
    return readers()[RECORDER].components_in(file) if RECORDER in readers() else ()


def _read_file(file: LandingFile, folder: str, now: datetime) -> tuple[pl.DataFrame, OpenFile]:
    """Read the rows of a component that can be stored, in SI, one column a signal; and the file's faults."""
    component = recorded_components()[folder]
    try:
        with panics_as_errors():
            numbers = ("pack", *(c.column for c in _channels(component)))
            (open_file,), raw = open_files([file], Contract(("flight_id", "report_time"), (), numbers), component.code)
            if raw.is_empty():
                return raw, open_file
            rows, faults = _validate(raw, component, now, MAX_PACKS if file.is_recording else file.packs)
            add_faults([open_file], [(0, fault) for fault in faults])
            return rows, open_file
    except Exception as error:
        return pl.DataFrame(), OpenFile([Fault("cannot_process", detail=first_line(error)), *file.find_change()])


def _validate(raw: pl.DataFrame, component: Component, now: datetime, packs: int) -> tuple[pl.DataFrame, list[Fault]]:
    """Select the rows that can be stored, in SI; faults of the others and of impossible values."""
    if "pack" not in raw.columns:
        raw = raw.with_columns(pack=pl.lit(1.0))
    numbered = raw.with_columns(counts_from_0=counts_from_0(pl.lit(packs)).over("flight_id"))
    judged = numbered.with_columns(reason=_reason(now, packs))
    bad_rows = judged.drop_nulls("reason").select("reason", "row", "counts_from_0").rows()
    good = raw.filter(judged["reason"].is_null())
    values, faults = _to_si(good, _channels(component))
    key = good.select(
        pl.lit(component.code).alias("component"),
        pl.col("flight_id").str.strip_chars(),
        pl.col("pack").cast(pl.Int32),
        pl.col("report_time").alias("time_utc"),
        "row",
    )
    details = {("bad_pack", True): FROM_0}
    refused = [
        Fault(reason, row, detail=details.get((reason, from_0), ""), n_rows=1) for reason, row, from_0 in bad_rows
    ]
    return key.hstack(values), [*refused, *faults]


def _reason(now: datetime, packs: int) -> pl.Expr:
    """Give the reason why a row is rejected; null where it is not."""
    moment = pl.col("report_time")
    has_id = pl.col("flight_id").str.strip_chars().str.contains(COMPONENT_FLIGHT_ID)
    return (
        pl.when(~has_id.fill_null(False)).then(pl.lit("bad_cycle_id"))
        .when(moment.is_null()).then(pl.lit("unreadable_time"))
        .when(moment < pl.lit(EARLIEST).cast(pl.Datetime("us", "UTC"))).then(pl.lit("too_early"))
        .when(in_future(now)).then(pl.lit("future_time"))
        .when(~is_pack(pl.lit(packs)) | pl.col("counts_from_0")).then(pl.lit("bad_pack"))
    )  # fmt: skip


def _to_si(rows: pl.DataFrame, channels: Sequence[Channel]) -> tuple[pl.DataFrame, list[Fault]]:
    """Convert signals to SI, null where the value is impossible; a fault for each such value."""
    columns = []
    faults = []
    for channel in channels:
        values = rows[channel.column] if channel.column in rows.columns else pl.Series([None] * rows.height)
        value = values.cast(pl.Float64) * channel.scale + channel.offset
        strange = value.is_not_null() & ~value.is_finite()
        outside = value.is_finite() & ~value.is_between(channel.low, channel.high)
        for reason, bad in (("not_a_number", strange), ("out_of_range", outside)):
            bad_rows = rows.filter(bad).select("row", channel.column).rows() if bad.any() else []
            faults += [Fault(reason, row, channel.column, f"Found {v:g}.") for row, v in bad_rows]
        columns.append(value.set((strange | outside).fill_null(False), None).alias(channel.signal))
    return pl.DataFrame(columns), faults


def _channels(component: Component) -> Sequence[Channel]:
    return component.record.channels if component.record else ()


def _with_aircraft(rows: pl.DataFrame, index: int, file: LandingFile) -> pl.DataFrame:
    """Add a file's aircraft to its rows: another's flights may have the same names."""
    frame = rows if rows.width else _NO_ROWS
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
    file: LandingFile, open_file: OpenFile, rows: pl.DataFrame, own_stored: pl.DataFrame, all_stored: pl.DataFrame
) -> FileIntake:
    """Sort the rows of one file into stored rows, duplicates and conflicts with the rows stored of any file."""
    others = rows.join(own_stored.select("row"), on="row", how="anti")
    signals = [c for c in rows.columns if c not in (*KEY, "row", "index")]
    same = others.join(all_stored, on=[*KEY, *signals], how="semi", nulls_equal=True) if others.height else others
    differ = others.join(same.select("row"), on="row", how="anti")
    detail = "Another row of this flight and time is stored."
    conflicts = [
        Fault("conflicting_delivery", row, detail=detail, n_rows=1, flight_id=flight)
        for row, flight in differ.select("row", "flight_id").rows()
    ]
    long = own_stored.unpivot(signals, index=KEY, variable_name="signal", value_name="value").drop_nulls("value")
    long = RawComponents.conform(long.with_columns(file=pl.lit(file.path)))
    return FileIntake(long, file.quarantine([*open_file.faults, *conflicts]), open_file.n_rows, same.height)
