"""Name airframes in the catalog: by their present operator and tail, or as each flight was delivered.

Stored rows are keyed by the operator and tail of an airframe's earliest line (`pipelines.intake.airframes`). Where some
airframe has another name now, the schema `tables` and the views over it, in the schema `airframes`, give every row the
present one, so that they join; a tail that another airframe has now is numbered there. The public views, in `main`, are
then made over these: a row of a flight or a file has operator and tail as delivered. In a fleet where no airframe
changed its name the public views are the only ones.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import duckdb
import polars as pl

from hdt_core.tables import TABLES
from pipelines.storage.store import Store

SCHEMA = "airframes"
_LINE = ["airframe_operator", "airframe_tail"]


@dataclass(frozen=True, slots=True)
class Name:
    """An operator and tail that an airframe had."""

    key: tuple[str, str]
    """Operator and tail under which its rows are stored."""
    present: tuple[str, str]
    """Operator and tail that it has now; the tail is numbered where another airframe has it now."""
    flight_tail: str
    """What ids of flights under this name begin with, as stored."""
    delivered: tuple[str, str]


def read_names(store: Store) -> list[Name]:
    """List the names of airframes that changed theirs, and of those that had one of these before or after."""
    lines = store.read_table("raw_fleet").drop_nulls(_LINE)
    changed = lines.filter((pl.col("operator") != pl.col(_LINE[0])) | (pl.col("tail") != pl.col(_LINE[1])))
    if changed.is_empty():
        return []
    names = lines.join(changed, on=_LINE, how="semi").select("operator", "tail")
    lines = lines.join(names, on=["operator", "tail"], how="semi").sort("valid_from", nulls_last=False)
    lines = lines.with_columns(pl.concat_str(pl.col("flight_prefix").fill_null(""), "tail").alias("flight_tail"))
    lines = lines.unique([*_LINE, "flight_tail"], keep="first", maintain_order=True)
    latest = _last_flights(store, lines)
    last = lines.join(latest, on=[*_LINE, "flight_tail"], how="left", maintain_order="left", validate="m:1")
    last = last.sort("departed_at", nulls_last=False, maintain_order=True).unique(
        _LINE, keep="last", maintain_order=True
    )
    present = dict[tuple[str, str], tuple[str, str]]()
    for *key, operator, tail in last.reverse().select(*_LINE, "operator", "tail").rows():
        n_later = sum(place[0] == operator and place[1].split(".")[0] == tail for place in present.values())
        present[key[0], key[1]] = operator, f"{tail}.{n_later}" if n_later else tail
    rows = lines.select(*_LINE, "flight_tail", "operator", "tail").rows()
    return [Name((o, t), present[o, t], flight_tail, (operator, tail)) for o, t, flight_tail, operator, tail in rows]


def _last_flights(store: Store, lines: pl.DataFrame) -> pl.DataFrame:
    """Find the last flight of each airframe under each of its names."""
    flights = store.read_table("raw_flights", lines.select(_LINE).unique().rows())
    name = pl.col("flight_id").str.head(-len("_YYYYMMDD_LL")).alias("flight_tail")
    return flights.group_by(pl.col("operator").alias(_LINE[0]), pl.col("tail").alias(_LINE[1]), name).agg(
        pl.col("departed_at").max()
    )


def with_present_names(select: str, table: str, names: Sequence[Name]) -> str:
    """Have a select over a table's files give airframes their present names."""
    columns = _LINE if table == "raw_fleet" else ["operator", "tail"]
    renamed = {name.key: name.present for name in names if name.key != name.present}
    if not renamed or not set(columns) <= set(TABLES[table].schema.columns()):
        return select
    replaced = [
        f"case {columns[0]} || '/' || {columns[1]}"
        + "".join(f" when '{'/'.join(key)}' then '{present[place]}'" for key, present in renamed.items())
        + f" else {column} end as {column}"
        for place, column in enumerate(columns)
    ]
    return f"select * replace ({', '.join(replaced)}) from ({select})"


_NAMES = {
    "key_operator": "operator by which stored rows name the airframe",
    "key_tail": "tail by which stored rows name it",
    "present_operator": "operator under which the ranking has it",
    "present_tail": "tail under which the ranking has it",
    "flight_tail": "tail in the ids of flights delivered under this name, with its prefix",
    "operator": "operator under which the flights were delivered",
    "tail": "tail under which they were delivered",
}


def add_names(con: duckdb.DuckDBPyConnection, names: Sequence[Name]) -> None:
    """Add the table of names, empty where no airframe changed its name."""
    con.execute(f"create table tables.names ({', '.join(f'{c} varchar' for c in _NAMES)})")
    for column, meaning in _NAMES.items():
        con.execute(f"comment on column tables.names.{column} is '{meaning}'")
    if names:
        rows = [(*n.key, *n.present, n.flight_tail, *n.delivered) for n in names]
        con.executemany(f"insert into tables.names values ({', '.join('?' * len(_NAMES))})", rows)


def names_in(con: duckdb.DuckDBPyConnection) -> list[Name]:
    """Read the table of names of an open catalog."""
    rows = con.execute("select * from tables.names").fetchall()
    return [Name((r[0], r[1]), (r[2], r[3]), r[4], (r[5], r[6])) for r in rows]


def public_view(name: str, columns: Sequence[str]) -> str:
    """Give the SQL of a public view over that of the schema `airframes`, with names as delivered."""
    source = f"{SCHEMA}.{name} as v"
    replaced = {c: f"regexp_replace(v.{c}, '^[A-Z][A-Z0-9]*\\.', '')" for c in columns if c.endswith("flight_id")}
    if {"operator", "tail"} <= set(columns) and "flight_prefix" not in columns:
        present = {"operator": "v.operator", "tail": "split_part(v.tail, '.', 1)"}
        if "flight_id" in columns:
            source += (
                " left join tables.names as n on v.operator = n.present_operator and v.tail = n.present_tail"
                " and v.flight_id[:-13] = n.flight_tail"
            )
            present = {c: f"coalesce(n.{c}, {sql})" for c, sql in present.items()}
        if "file" in columns:
            in_folder = "len(string_split(v.file, '/')) > 2"
            folder = {c: f"split_part(v.file, '/', {place})" for place, c in enumerate(present, 1)}
            present = {c: f"case when {in_folder} then {folder[c]} else {sql} end" for c, sql in present.items()}
        replaced |= present
    values = ", ".join(f"{sql} as {column}" for column, sql in replaced.items())
    return f"create view {name} as select v.*{f' replace ({values})' if values else ''} from {source}"


def columns_of(con: duckdb.DuckDBPyConnection) -> Mapping[str, list[str]]:
    """Map each view of the current schema to its columns."""
    return dict(con.execute(_COLUMNS).fetchall())


_COLUMNS = """
select table_name, list(column_name order by column_index) from duckdb_columns()
where database_name = current_database() and schema_name = current_schema() and not internal
group by table_name order by table_name"""
