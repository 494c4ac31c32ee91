"""Which file of an aircraft holds a month of flights: its own while flights are likely to come, then its year's.

After four years that is a seventh of what a file a month would be. The write that opens another month folds those
that are no longer among the newest into their years, in its own commit.
"""

import re
from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

import polars as pl

from hdt_core.tables import StoredTable
from pipelines.storage.delta import Change, Held

OPEN = 3
"""Newest months of an aircraft with a file each; late flights seldom reach further back, and then rewrite a year."""
_MONTH = re.compile(r"\d{4}-\d{2}")


def shards_with(
    entry: StoredTable, folders: Iterable[str], flights: Iterable[str], there: Collection[str]
) -> list[str]:
    """Shards of some aircraft in which some flights can be; `there` are those of the whole table."""
    names = _named(flights, entry)["shard"].unique().sort()
    own = ((f"{folder}/{n}", f"{folder}/{_year(n)}") for folder in folders for n in names)
    return list(dict.fromkeys(shard if shard in there else year for shard, year in own))


def in_shard(name: str) -> pl.Expr:
    """Whether a row whose own shard would be the column `shard` can be in the shard `name`."""
    own = pl.col("shard")
    return (own == name) | (own.str.contains(f"^{_MONTH.pattern}$") & (own.str.head(4) == name))


def without_folded(entry: StoredTable, frames: Mapping[str, pl.DataFrame]) -> dict[str, pl.DataFrame]:
    """An aircraft's shards less the months that lie in their years: what was folded stays until it is vacuumed."""
    kept = {}
    for shard, frame in frames.items():
        folder, _, name = shard.rpartition("/")
        year = frames.get(f"{folder}/{_year(name)}") if _MONTH.fullmatch(name) else None
        if not _holds(entry, year, name):
            kept[shard] = frame
    return kept


def merged(entry: StoredTable, folder: str, flights: Iterable[str], frame: pl.DataFrame) -> Change:
    """An aircraft's shards with the rows of `flights` replaced by `frame`."""
    ids = {name: own["flight_id"] for name, own in _parted(_named(flights, entry)).items()}
    fresh = _parted(frame.with_columns(entry.shard_of))

    def change(held: Held) -> Iterator[tuple[str, pl.DataFrame | None]]:
        for shard, names in _targets(entry, folder, ids, fresh, held).items():
            taken_in = [s for name in names if (s := f"{folder}/{name}") in held and s != shard]
            before = [entry.conform(held[s]) for s in (shard, *taken_in) if s in held]
            new = [entry.conform(fresh[name]) for name in names if name in fresh]
            replaced = [flight for name in names for flight in ids.get(name, ())]
            kept = [b.filter(~pl.col("flight_id").is_in(replaced)) for b in before]
            if kept or new:
                yield shard, pl.concat([*kept, *new], how="diagonal").sort(entry.key)
                yield from dict.fromkeys(taken_in).items()

    return change


def _targets(
    entry: StoredTable, folder: str, asked: Collection[str], fresh: Collection[str], held: Held
) -> dict[str, list[str]]:
    """Shards to write, each with the months (or flights, where a shard is one) whose rows it will hold."""
    own = {s.removeprefix(f"{folder}/") for s in held if s.startswith(f"{folder}/")}
    months = sorted(name for name in own.union(fresh) if _MONTH.fullmatch(name))
    old, found = set(months[:-OPEN]), dict[str, list[str]]()
    for name in sorted(old.union(asked)):
        year = _year(name)
        folded = name in old or (name not in own and _holds(entry, held.get(f"{folder}/{year}"), name))
        found.setdefault(f"{folder}/{year if folded else name}", []).append(name)
    return found


def _holds(entry: StoredTable, year: pl.DataFrame | None, month: str) -> bool:
    return year is not None and bool(year.select((entry.shard_of == month).any()).item())


def _year(name: str) -> str:
    """The shard into which a month is folded; of what is no month itself."""
    return name[:4] if _MONTH.fullmatch(name) else name


def _parted(rows: pl.DataFrame) -> dict[str, pl.DataFrame]:
    parts = rows.partition_by("shard", as_dict=True, include_key=False)
    return {str(name): own for (name,), own in parts.items()}


def _named(flights: Iterable[Any], entry: StoredTable) -> pl.DataFrame:
    return pl.DataFrame({"flight_id": list(flights)}, schema={"flight_id": pl.String}).with_columns(entry.shard_of)
