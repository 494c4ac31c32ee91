"""Where tables, the ledger and the catalog are kept: files or objects, SQLite or PostgreSQL, DuckDB."""
