"""Keep tables, ledger and catalog: files or objects, SQLite or PostgreSQL, DuckDB."""
