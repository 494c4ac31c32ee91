"""Databases of a test's own, where HDT_TEST_POSTGRES names a server."""

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

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
