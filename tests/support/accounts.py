"""Where the rows of each file went, counted from what the intake gave."""

import polars as pl


def account(
    delivered: pl.DataFrame, rows: pl.DataFrame, duplicates: pl.DataFrame, quarantined: pl.DataFrame
) -> pl.DataFrame:
    """Ledger per file: delivered, loaded, quarantined, duplicate, and whether they balance.

    Parameters
    ----------
    delivered : DataFrame
        `file, n_delivered`, counted when the file was opened and not derived from the other three.
    rows, duplicates, quarantined : DataFrame
        What `merge_deliveries` returned.

    Returns
    -------
    DataFrame
        `file, delivered, loaded, quarantined, duplicate, balanced`, sorted by file.
    """
    parts = (
        rows.group_by("file").agg(pl.len().cast(pl.Int64).alias("loaded")),
        quarantined.group_by("file").agg(pl.col("n_rows").sum().alias("quarantined")),
        duplicates.group_by("file").agg(pl.col("n_duplicate").sum().alias("duplicate")),
    )
    ledger = delivered.group_by("file").agg(pl.col("n_delivered").sum().alias("delivered"))
    for part in parts:
        ledger = ledger.join(part, on="file", how="full", coalesce=True, validate="m:1")
    ledger = ledger.with_columns(pl.col("delivered", "loaded", "quarantined", "duplicate").fill_null(0))
    balanced = pl.col("delivered") == pl.col("loaded") + pl.col("quarantined") + pl.col("duplicate")
    return ledger.with_columns(balanced.alias("balanced")).sort("file")
