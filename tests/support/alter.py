"""Other values in some rows of a table."""

import polars as pl


def alter(rows: pl.DataFrame, where: pl.Expr, **values: object) -> pl.DataFrame:
    """The rows, with these values or expressions in their columns where the condition holds."""
    return rows.with_columns(pl.when(where).then(value).otherwise(name).alias(name) for name, value in values.items())
