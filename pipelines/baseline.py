"""Select the data the Digital System Model is fitted to; records of later flights do not make it stale."""

import polars as pl

from hdt_core.flight.windows import baseline_flights
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import accepted_terms
from pipelines.storage.store import Store


def baseline_cells(ledger: Ledger) -> pl.DataFrame:
    """Return the commissioning window: operator, tail, flight_id, version. A flight id sorts by day and leg."""
    cells = ledger.cells("legs_samples")
    flights = baseline_flights(cells.with_columns(departed_at=pl.col("flight_id").str.slice(-11)))
    return cells.filter(pl.col("flight_id").is_in(flights))


def baseline_records(store: Store, table: str, cells: pl.DataFrame) -> pl.DataFrame:
    """Read messages, maintenance or printed reports up to the day of each aircraft's last baseline flight."""
    return records_until(store.read_table(table), cells)


def records_until(records: pl.DataFrame, cells: pl.DataFrame) -> pl.DataFrame:
    """Return the records up to the day of each aircraft's last flight in `cells`."""
    on = next(pl.col(c).cast(pl.Date) for c in ("message_time", "reported_at", "done_on") if c in records.columns)
    day = pl.col("flight_id").str.slice(-11, 8).str.to_date("%Y%m%d").max().alias("last_day")
    last = cells.group_by("operator", "tail").agg(day)
    return records.join(last, on=["operator", "tail"], validate="m:1").filter(on <= pl.col("last_day")).drop("last_day")


def baseline_inputs(ledger: Ledger) -> list[str]:
    """Return the model's inputs as lines to be hashed."""
    store, cells = Store(ledger.home), baseline_cells(ledger)
    records = [baseline_records(store, t, cells) for t in ("raw_messages", "raw_maintenance", "raw_reports")]
    terms = [f"term {name}" for name in accepted_terms(ledger.home)]
    return [line for frame in (cells, *records) for line in sorted(map(str, frame.rows()))] + terms
