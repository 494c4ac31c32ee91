"""Fold an aircraft's files by month into files by year once late flights have become unlikely.

After four years that is a seventh of the files. The write that adds a month folds those that are no longer among the
newest into their years, in the same commit.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import polars as pl

from hdt_core.tables import StoredTable
from pipelines.storage.delta import Change, StoredShards

OPEN = 3
"""Newest months of an aircraft with a file each; late flights seldom reach further back, and then rewrite a year."""
_MONTH = re.compile(r"\d{4}-\d{2}")


def shards_with(
    entry: StoredTable, folders: Iterable[str], flights: Iterable[str], stored: Collection[str]
) -> list[str]:
    """List shards of some aircraft in which some flights can be; `stored` are those of the whole table."""
    names = _with_shard(flights, entry)["shard"].unique().sort()
    pairs = ((f"{folder}/{n}", f"{folder}/{_year(n)}") for folder in folders for n in names)
    return list(dict.fromkeys(shard if shard in stored else year for shard, year in pairs))


def in_shard(name: str) -> pl.Expr:
    """Return whether a row whose own shard would be the column `shard` can be in the shard `name`."""
    own = pl.col("shard")
    return (own == name) | (own.str.contains(f"^{_MONTH.pattern}$") & (own.str.head(4) == name))


def without_folded(entry: StoredTable, frames: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """Drop months of an aircraft that are in their year already: a folded file stays until it is vacuumed."""
    current = {}
    for shard, frame in frames.items():
        folder, _, name = shard.rpartition("/")
        year = frames.get(f"{folder}/{_year(name)}") if _MONTH.fullmatch(name) else None
        if not _holds(entry, year, name):
            current[shard] = frame
    return current


def merge_flights(entry: StoredTable, folder: str, flights: Iterable[str], frame: pl.DataFrame) -> Change:
    """Replace the rows of `flights` in an aircraft's shards by `frame`."""
    ids = {name: rows["flight_id"] for name, rows in _by_shard(_with_shard(flights, entry)).items()}
    fresh = _by_shard(frame.with_columns(entry.shard_of))

    def change(shards: StoredShards) -> Iterator[tuple[str, pl.DataFrame | None]]:
        for shard, names in _targets(entry, folder, ids, fresh, shards).items():
            months = [s for name in names if (s := f"{folder}/{name}") in shards and s != shard]
            rows = [entry.conform(shards[s]) for s in (shard, *months) if s in shards]
            new = [entry.conform(fresh[name]) for name in names if name in fresh]
            flight_ids = [flight for name in names for flight in ids.get(name, ())]
            others = [frame.filter(~pl.col("flight_id").is_in(flight_ids)) for frame in rows]
            if others or new:
                yield shard, pl.concat([*others, *new], how="diagonal").sort(entry.key)
                yield from dict.fromkeys(months).items()

    return change


def _targets(
    entry: StoredTable, folder: str, names_to_write: Collection[str], fresh: Collection[str], shards: StoredShards
) -> dict[str, list[str]]:
    """Map shards to write to the months (or flights, where a shard is one) whose rows they will hold."""
    names = {s.removeprefix(f"{folder}/") for s in shards if s.startswith(f"{folder}/")}
    months = sorted(name for name in names.union(fresh) if _MONTH.fullmatch(name))
    old, targets = set(months[:-OPEN]), dict[str, list[str]]()
    for name in sorted(old.union(names_to_write)):
        year = _year(name)
        in_year = name in old or (name not in names and _holds(entry, shards.get(f"{folder}/{year}"), name))
        targets.setdefault(f"{folder}/{year if in_year else name}", []).append(name)
    return targets


def _holds(entry: StoredTable, year: pl.DataFrame | None, month: str) -> bool:
    return year is not None and bool(year.select((entry.shard_of == month).any()).item())


def _year(name: str) -> str:
    """Name the shard into which a month is folded; any other name is its own."""
    return name[:4] if _MONTH.fullmatch(name) else name


def _by_shard(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    parts = rows.partition_by("shard", as_dict=True, include_key=False)
    return {str(name): part for (name,), part in parts.items()}


def _with_shard(flights: Iterable[Any], entry: StoredTable) -> pl.DataFrame:
    return pl.DataFrame({"flight_id": list(flights)}, schema={"flight_id": pl.String}).with_columns(entry.shard_of)
