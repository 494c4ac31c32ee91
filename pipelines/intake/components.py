"""Files of declared components become judged rows in SI, one a flight, pack, time and signal."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import polars as pl

from hdt_core.components import Channel, Component, recorded_components
from hdt_core.tables.components import COMPONENT_FLIGHT_ID
from pipelines.intake.columns import Contract
from pipelines.intake.header import judge_header
from pipelines.intake.landing_file import RECORDER, LandingFile
from pipelines.intake.ledger import Fault, quarantine, shortened
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
    """What came of one file: rows in long form (`SCHEMA`), what is wrong with it, and where its lines went."""

    rows: pl.DataFrame
    quarantine: pl.DataFrame
    n_delivered: int
    n_loaded: int
    n_duplicate: int

    @property
    def n_good(self) -> int:
        """Lines that could be stored, were there no other delivery."""
        return self.n_loaded + self.n_duplicate + self.quarantine.filter(reason="conflicting_delivery").height


def read_components(files: Sequence[LandingFile], now: datetime) -> list[tuple[LandingFile, ComponentIntake]]:
    """What came of each file, of a recording once for each component; deliveries of one flight are settled among them.

    Parameters
    ----------
    files : sequence of LandingFile
        Of one or several aircraft, all that hold a component of them.
    now : datetime
        Times after it lie in the future. UTC.

    Returns
    -------
    list of (LandingFile, Delivered)
        In the order of `files`. Counts are of lines; each line is stored, kept aside or said nothing new. Never raises
        for what a file holds.
    """
    held = [(file, code) for file in files for code in _components_in(file)]
    read = [_one_file(file, code, now) for file, code in held]
    keys = pl.DataFrame(schema={**{k: SCHEMA[k] for k in KEY}, "row": pl.Int64(), "index": pl.Int64()})
    wide = pl.concat([keys, *(_placed(f.rows, i, held[i][0]) for i, f in enumerate(read))], how="diagonal")
    won = _settled(wide)
    mine, kept = (f.partition_by("index", as_dict=True) for f in (wide, won))
    return [
        (held[i][0], _delivered(held[i][0], f, mine.get((i,), wide.clear()), kept.get((i,), won.clear()), won))
        for i, f in enumerate(read)
    ]


@dataclass(slots=True)
class _Read:
    """A file's rows, one column a signal, and what is wrong with it."""

    rows: pl.DataFrame
    faults: list[Fault]
    n_rows: int = 0


def _components_in(file: LandingFile) -> tuple[str, ...]:
    """Folders of the components that a file describes: its own folder's, or those of its aircraft's type."""
    if not file.is_recording:
        return (file.folder,)
    return readers()[RECORDER].components_in(file) if RECORDER in readers() else ()


def _one_file(file: LandingFile, folder: str, now: datetime) -> _Read:
    component = recorded_components()[folder]
    try:
        with panics_as_errors():
            if file.is_recording:
                frame, n_rows, faults = readers()[RECORDER].rows(file, component.code)
                return _judged(frame, _Read(pl.DataFrame(), faults, n_rows), None, component, now, MAX_PACKS)
            frame, text, found = _opened(file, component)
            return _judged(frame, found, text, component, now, file.packs)
    except Exception as error:
        return _Read(pl.DataFrame(), [Fault("cannot_process", detail=first_line(error))])


def _opened(file: LandingFile, component: Component) -> tuple[pl.DataFrame, Text | None, _Read]:
    """Known columns of a file in recorded units, `report_time` in UTC, `row` its line."""
    names = tuple(c.column for c in _channels(component))
    content, faults = file.read()
    if content is None:
        return pl.DataFrame(), None, _Read(pl.DataFrame(), faults)
    if file.is_text:
        text = open_text(content, lambda found: judge_header(found, REQUIRED, ("pack", *names)))
        frame, found = to_columns([text], ("pack", *names))
        told = _Read(pl.DataFrame(), [*text.faults, *found[0]], text.n_rows)
    else:
        text = None
        frame, n_rows, faults = open_parquet(content, None, Contract(REQUIRED, (), ("pack", *names)))
        told = _Read(pl.DataFrame(), faults, n_rows)
    if frame.height:
        frame, naive = to_utc(frame, "report_time")
        told.faults += zone_note(naive, "report_time")
    return frame, text, told


def _judged(
    frame: pl.DataFrame, told: _Read, text: Text | None, component: Component, now: datetime, packs: int
) -> _Read:
    """Rows that can be stored, in SI; the others and the values at fault among the faults."""
    if frame.is_empty():
        return told
    if "pack" not in frame.columns:
        frame = frame.with_columns(pack=pl.lit(1.0))
    reasons = frame.select(_reason(now, packs).alias("reason"))["reason"]
    for row, reason in zip(frame["row"].filter(reasons.is_not_null()), reasons.drop_nulls(), strict=True):
        told.faults.append(Fault(reason, row, n_rows=1, content=text.line(row) if text else None))
    good = frame.filter(reasons.is_null())
    values, faults = _in_si(good, _channels(component))
    refused = {f.row for f in told.faults if f.n_rows}
    told.faults = [f for f in told.faults if f.reason != "not_a_number" or f.row not in refused] + shortened(faults)
    key = good.select(
        pl.lit(component.code).alias("component"),
        pl.col("flight_id").str.strip_chars(),
        pl.col("pack").cast(pl.Int32),
        pl.col("report_time").alias("time_utc"),
        "row",
    )
    return _Read(key.hstack(values), told.faults, told.n_rows)


def _reason(now: datetime, packs: int) -> pl.Expr:
    """Why a row is refused; null where it is not."""
    moment, pack = pl.col("report_time"), pl.col("pack")
    named = pl.col("flight_id").str.strip_chars().str.contains(COMPONENT_FLIGHT_ID)
    of_aircraft = (pack.is_between(1, packs) & (pack == pack.floor())).fill_null(False)
    return (
        pl.when(~named.fill_null(False)).then(pl.lit("bad_cycle_id"))
        .when(moment.is_null()).then(pl.lit("unreadable_time"))
        .when(moment < pl.lit(EARLIEST).cast(pl.Datetime("us", "UTC"))).then(pl.lit("too_early"))
        .when(moment > pl.lit(now).dt.cast_time_unit("us")).then(pl.lit("future_time"))
        .when(~of_aircraft).then(pl.lit("bad_pack"))
    )  # fmt: skip


def _in_si(rows: pl.DataFrame, channels: Sequence[Channel]) -> tuple[pl.DataFrame, list[Fault]]:
    """Signals in SI, null where the value can't be; a fault for each such value."""
    columns, faults = [], []
    for channel in channels:
        recorded = rows[channel.column] if channel.column in rows.columns else pl.Series([None] * rows.height)
        value = recorded.cast(pl.Float64) * channel.scale + channel.offset
        strange = value.is_not_null() & ~value.is_finite()
        outside = value.is_finite() & ~value.is_between(channel.low, channel.high)
        for reason, bad in (("not_a_number", strange), ("out_of_range", outside)):
            found = rows.filter(bad.fill_null(False)).select("row", channel.column) if bad.any() else None
            told = found.rows() if found is not None else []
            faults += [Fault(reason, row, channel.column, f"Found {v:g}.") for row, v in told]
        columns.append(value.set((strange | outside).fill_null(False), None).alias(channel.signal))
    return pl.DataFrame(columns), faults


def _channels(component: Component) -> Sequence[Channel]:
    return component.record.channels if component.record else ()


def _placed(rows: pl.DataFrame, index: int, file: LandingFile) -> pl.DataFrame:
    """Rows of one file with the aircraft they belong to: another's flights may bear the same names."""
    keys = {**{k: SCHEMA[k] for k in KEY}, "row": pl.Int64()}
    frame = rows if rows.width else pl.DataFrame(schema=keys)
    return frame.with_columns(
        pl.lit(index, pl.Int64).alias("index"), operator=pl.lit(file.operator), tail=pl.lit(file.tail)
    )


def _settled(wide: pl.DataFrame) -> pl.DataFrame:
    """Rows that are stored: of each flight those of one file, the one with most rows, then the last by name."""
    sizes = wide.group_by(*FLIGHT, "index").len().sort("len", "index", descending=True)
    first = sizes.unique(FLIGHT, keep="first", maintain_order=True).drop("len")
    own = wide.join(first, on=[*FLIGHT, "index"], how="semi").sort("index", "row")
    return own.unique([*KEY, "index"], keep="first", maintain_order=True)


def _delivered(
    file: LandingFile, read: _Read, mine: pl.DataFrame, kept: pl.DataFrame, won: pl.DataFrame
) -> ComponentIntake:
    """What became of `mine`, the rows of one file, of which `kept` are stored; `won` are those stored of any file."""
    lost = mine.join(kept.select("row"), on="row", how="anti")
    signals = [c for c in mine.columns if c not in (*KEY, "row", "index")]
    same = lost.join(won, on=[*KEY, *signals], how="semi", nulls_equal=True) if lost.height else lost
    differ = lost.join(same.select("row"), on="row", how="anti")
    conflicts = [
        Fault("conflicting_delivery", row, detail="Another row of this flight and time is stored.", n_rows=1,
              flight_id=flight)
        for row, flight in differ.select("row", "flight_id").rows()
    ]  # fmt: skip
    rows = kept.unpivot(signals, index=KEY, variable_name="signal", value_name="value").drop_nulls("value")
    told = quarantine(file.path, file.received_at, [*read.faults, *conflicts])
    stored = rows.with_columns(file=pl.lit(file.path)).select(pl.col(c).cast(t) for c, t in SCHEMA.items())
    return ComponentIntake(stored, told, read.n_rows, kept.height, same.height)
