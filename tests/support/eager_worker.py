"""A worker's modules after a query, as where a package makes one while it is loaded."""

import polars as pl

pl.DataFrame({"loaded": [1, 2]}).select(pl.col("loaded").sum())

import pipelines.orchestration.worker  # noqa: E402, F401
