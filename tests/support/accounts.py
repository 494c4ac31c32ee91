"""Where the rows of each file went, counted from what the intake gave."""

import polars as pl


def balances(delivered: pl.DataFrame, rows: pl.DataFrame, duplicates: pl.DataFrame, quarantined: pl.DataFrame) -> bool:
    """Whether each file's rows are loaded, set aside or duplicate: `delivered` counts them as the file is opened."""
    parts = (
        delivered.group_by("file").agg(pl.col("n_delivered").sum().alias("n")),
        rows.group_by("file").agg(-pl.len().cast(pl.Int64).alias("n")),
        quarantined.group_by("file").agg(-pl.col("n_rows").sum().cast(pl.Int64).alias("n")),
        duplicates.group_by("file").agg(-pl.col("n_duplicate").sum().cast(pl.Int64).alias("n")),
    )
    left = pl.concat(part.select("file", pl.col("n").cast(pl.Int64)) for part in parts)
    return left.group_by("file").agg(pl.col("n").sum()).filter(pl.col("n") != 0).is_empty()
