"""Declare tables: columns with type, unit, span and meaning; describe rules that a frame breaks."""

from typing import Any, TypeVar

import dataframely as dy
import polars as pl

OPERATOR = r"^[A-Z][A-Z0-9]{1,7}$"
"""An ICAO airline code, or a fleet's own name."""
TAIL = r"^[A-Z0-9-]{2,10}$"
"""A registration, as a folder has it."""
AIRFRAME_TAIL = r"^[A-Z0-9-]{2,10}(\.\d+)?$"
"""The same as the key of an airframe: numbered where another airframe had it before."""
FLIGHT_ID = r"^[A-Z0-9-]{2,10}_\d{8}_\d{2}$"
"""A flight as it was delivered."""
STORED_FLIGHT_ID = rf"^({OPERATOR[1:-1]}\.)?{FLIGHT_ID[1:]}"
"""The same as it is stored: after its operator where the airframe had the tail under another one."""
UTC = pl.Datetime("us", "UTC")


Column = TypeVar("Column", bound=dy.Column)


def column(
    dtype: type[Column],
    meaning: str,
    unit: str = "",
    *,
    nullable: bool = False,
    value: pl.Expr | None = None,
    **kw: Any,
) -> Column:
    """A column of any type: an index, a day, bytes; `value` where it follows from other columns."""
    return dtype(nullable=nullable, metadata={"unit": unit, "meaning": meaning, "value": value}, **kw)


def number(
    meaning: str,
    unit: str = "-",
    low: float | None = None,
    high: float | None = None,
    *,
    nullable: bool = True,
    **kw: Any,
) -> dy.Float64:
    """A physical quantity: null where missing, never NaN."""
    return column(dy.Float64, meaning, unit, nullable=nullable, min=low, max=high, **kw)


def count(meaning: str, unit: str = "-", *, nullable: bool = False) -> dy.Int64:
    """A count, zero or more."""
    return column(dy.Int64, meaning, unit, nullable=nullable, min=0)


def text(meaning: str, *, nullable: bool = True, **kw: Any) -> dy.String:
    """A code or a sentence."""
    return column(dy.String, meaning, nullable=nullable, **kw)


def flag(meaning: str, *, nullable: bool = False) -> dy.Bool:
    """Yes or no."""
    return column(dy.Bool, meaning, nullable=nullable)


def moment(meaning: str, **kw: Any) -> dy.Datetime:
    """A point in time, UTC."""
    return column(dy.Datetime, meaning, "UTC", time_zone="UTC", time_unit="us", **kw)


def operator_key(*, primary_key: bool = True) -> dy.String:
    """Operator: part of the key, for an aircraft may change hands and keep its registration."""
    return text("ICAO airline code or a fleet's own name", nullable=False, primary_key=primary_key, regex=OPERATOR)


def tail_key(*, primary_key: bool = True) -> dy.String:
    """Registration."""
    return text("aircraft registration", nullable=False, primary_key=primary_key, regex=AIRFRAME_TAIL)


def flight_key() -> dy.String:
    """Flight id: tail, UTC date of departure, leg of that day."""
    meaning = "tail, UTC day of departure and leg, `TAIL_YYYYMMDD_LEG`"
    return text(meaning, nullable=False, primary_key=True, regex=STORED_FLIGHT_ID)


COMPONENT_FLIGHT_ID = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,39}$"
"""A flight, cycle or mission as a component's own record numbers them."""


def pack_key() -> dy.Int32:
    """Air-conditioning pack: 1 left, 2 right."""
    return column(dy.Int32, "air-conditioning pack, 1 left, 2 right", primary_key=True, min=1, max=4)


def component_key() -> dy.String:
    """Code of a component as part of the key."""
    return text("code of the component", nullable=False, primary_key=True)


_RULES = {
    "nullability": "is empty",
    "nan": "is NaN",
    "inf": "is infinite",
    "min": "is below",
    "max": "is above",
    "regex": "is not of the form",
}


def finite(frame: pl.DataFrame) -> pl.DataFrame:
    """Replace NaN and infinity by null."""
    numbers = pl.selectors.float()
    return frame.with_columns(pl.when(numbers.is_finite()).then(numbers))


class Table(dy.Schema):
    """A declared table; its first docstring line defines a row."""

    @classmethod
    def types(cls, *without: str) -> dict[str, pl.DataType]:
        """Return the types by column, but for some.

        A module builds its empty frames of them: an expression or `create_empty` would start Polars' threads, which a
        forked worker does not have, so that it would wait for them forever.
        """
        return {name: column.dtype for name, column in cls.columns().items() if name not in without}

    @classmethod
    def faults(cls, frame: pl.DataFrame) -> list[str]:
        """Describe each broken rule of `frame` in a sentence; empty for a valid frame."""
        missing = [f"column {c} is missing" for c in cls.columns() if c not in frame.columns]
        if missing:
            return missing
        _, failure = cls.filter(frame)
        return [f"{cls._in_words(rule)} in {n} of {frame.height} rows" for rule, n in failure.counts().items()]

    @staticmethod
    def count_faults(invalid: pl.DataFrame, n_rows: int) -> list[str]:
        """Describe each broken rule of `split_valid`'s invalid rows, with their number of `n_rows`."""
        rules = invalid["faults"].str.split("; ").explode(empty_as_null=False).value_counts(sort=True)
        return [f"{rule} in {n} of {n_rows} rows" for rule, n in rules.iter_rows()]

    @classmethod
    def split_valid(cls, frame: pl.DataFrame) -> tuple[pl.DataFrame, pl.DataFrame]:
        """Split `frame` into valid rows, and declared columns of invalid ones with their `faults`.

        All rows that share a key are invalid.
        """
        _, failure = cls.filter(frame)
        if not len(failure):
            return frame, frame.select(list(cls.columns())).clear().with_columns(pl.lit("").alias("faults"))
        rules = list(failure.counts())
        messages = (pl.when(pl.col(r).cast(pl.String) == "invalid").then(pl.lit(cls._in_words(r))) for r in rules)
        faults = pl.concat_list(messages).list.drop_nulls().list.join("; ").alias("faults")
        invalid = failure.details().select(*cls.columns(), faults)
        on = cls.primary_key() or list(cls.columns())
        return frame.join(invalid, on=on, how="anti", nulls_equal=True, maintain_order="left"), invalid

    @classmethod
    def _in_words(cls, rule: str) -> str:
        """Describe a broken rule: `sd|min` is `sd is below 0`."""
        name, _, kind = rule.partition("|")
        if name == "primary_key":
            return f"the key ({', '.join(cls.primary_key())}) stands more than once"
        column = cls.columns().get(name)
        relation = _RULES.get(kind, kind.replace("_", " "))
        return f"{name} {relation} {getattr(column, kind, '')}".rstrip()

    @classmethod
    def derive(cls, frame: pl.DataFrame) -> pl.DataFrame:
        """Add the columns whose declared value follows from columns that `frame` has."""
        rows = frame
        for name, column in cls.columns().items():
            value = (column.metadata or {}).get("value")
            if value is not None and set(value.meta.root_names()) <= set(rows.columns):
                rows = rows.with_columns(value.alias(name))
        return rows

    @classmethod
    def conform(cls, frame: pl.DataFrame) -> pl.DataFrame:
        """Return `frame` with the declared columns in the declared order and types.

        Absent columns become null, others are dropped.
        """
        return frame.select(
            (pl.col(name) if name in frame.columns else pl.lit(None)).cast(column.dtype).alias(name)
            for name, column in cls.columns().items()
        ).head(frame.height)  # of a frame without columns, nulls alone would be a row


class AircraftTable(Table):
    """A table of aircraft: operator and tail begin the key."""

    operator = operator_key()
    tail = tail_key()


class AircraftRows(Table):
    """A table with operator and tail outside the key."""

    operator = operator_key(primary_key=False)
    tail = tail_key(primary_key=False)


class FlightTable(AircraftTable):
    """A table of flights: an aircraft's flight begins the key."""

    flight_id = flight_key()


class LegTable(FlightTable):
    """A table of legs: an aircraft's flight and a pack are the key, or begin it."""

    pack = pack_key()


class DatedLegTable(LegTable):
    """A table of legs with their departure."""

    departed_at = moment("first recorded time")


class ComponentLegTable(AircraftTable):
    """A table of legs of any component, declared ones too, which may number flights in their own way."""

    flight_id = text(
        "flight `TAIL_YYYYMMDD_LEG`, or cycle as the component's own record names it", nullable=False, primary_key=True,
        regex=f"{STORED_FLIGHT_ID}|{COMPONENT_FLIGHT_ID}",
    )  # fmt: skip
    pack = pack_key()
