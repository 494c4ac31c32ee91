"""Databases of a test's own, where HDT_TEST_POSTGRES names a server."""

import os
import sqlite3
import uuid
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from pipelines.storage.ledger import FILE, NAMES, Ledger

SERVER = os.environ.get("HDT_TEST_POSTGRES", "")


@contextmanager
def new_database() -> Iterator[str]:
    """Address of a new database, which is dropped in the end, whoever is still connected."""
    import psycopg2

    name = f"hdt_{uuid.uuid4().hex}"
    admin = psycopg2.connect(SERVER)
    admin.autocommit = True
    admin.cursor().execute(f"create database {name}")
    try:
        yield f"{SERVER.rpartition('/')[0]}/{name}"
    finally:
        admin.cursor().execute(f"drop database {name} with (force)")
        admin.close()


def copy_ledger_to(home: Path, url: str) -> None:
    """Copy a home's ledger from its file into the database at `url`."""
    with closing(sqlite3.connect(home / FILE)) as file, Ledger(home, url=url)._write(settled=True) as con:
        for name in NAMES:
            rows = file.execute(f"select * from {name}").fetchall()
            if rows:
                con.executemany(f"insert into {name} values ({', '.join('?' * len(rows[0]))})", rows)
