"""Where the rows of each file went, counted from what the intake gave."""

import polars as pl


def balances(delivered: pl.DataFrame, rows: pl.DataFrame, duplicates: pl.DataFrame, quarantined: pl.DataFrame) -> bool:
    """Whether each file's rows are loaded, set aside or duplicate: `delivered` counts them as the file is opened."""
    parts = (
        (delivered, pl.col("n_delivered").sum(), 1),
        (rows, pl.len(), -1),
        (quarantined, pl.col("n_rows").sum(), -1),
        (duplicates, pl.col("n_duplicate").sum(), -1),
    )
    left = pl.concat(f.group_by("file").agg((sign * count.cast(pl.Int64)).alias("n")) for f, count, sign in parts)
    return left.group_by("file").agg(pl.col("n").sum()).filter(pl.col("n") != 0).is_empty()
