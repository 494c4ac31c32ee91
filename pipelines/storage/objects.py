"""Store tables in an object store: S3, or a server with the same interface.

Server and keys are those of the usual AWS_* variables.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import chain
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from obstore.store import S3Store


class StoreError(OSError):
    """The tables can't be read or written; the message is one line."""


def message_of(error: BaseException) -> str:
    """Return the first line of an error's message; for libraries whose messages name the kind of error."""
    return str(error).strip().splitlines()[0]


@dataclass(frozen=True)
class Bucket:
    """Tables as objects below one URL, `s3://bucket/prefix`."""

    url: str
    remote: ClassVar[bool] = True
    suspect: ClassVar[bool] = False
    """Always False: a store checks its own checksums, and no night makes an object again."""

    @cached_property
    def store(self) -> "S3Store":
        """The client; it tries again by itself where the network fails."""
        try:
            from obstore.store import S3Store
        except ImportError:
            raise StoreError("an object store needs the extra s3: pip install 'hybrid-digital-twin[s3]'") from None
        return S3Store.from_url(self.url, client_options={"allow_http": _plain_http()})

    @property
    def options(self) -> dict[str, str]:
        """Storage options for readers and writers of the objects.

        A commit is written on condition that there is none of its number: of two writers the second is refused.
        """
        return {"aws_allow_http": str(_plain_http()).lower(), "aws_conditional_put": "etag"}

    def get(self, path: str) -> bytes:
        """Read an object whole."""
        import obstore

        with one_line():
            try:
                return bytes(obstore.get(self.store, path).bytes())
            except FileNotFoundError:
                raise StoreError(f"{self.url}/{path} is gone") from None

    def put(self, path: str, content: bytes) -> None:
        """Write an object."""
        import obstore

        sys.audit("hdt.before_write")
        with one_line():
            obstore.put(self.store, path, content)

    def mark_suspect(self) -> None:
        """Do nothing: see `suspect`."""

    clear_suspicion = mark_suspect

    def sync_commit(self, table: str, version: int) -> None:
        """Do nothing: an object that the store has accepted is durable."""

    def sweep(self) -> int:
        """Do nothing: a killed writer leaves no partial object, and the next vacuum removes what no table names."""
        return 0

    def sizes(self, prefix: str) -> dict[str, int]:
        """List the size in bytes of each object below a prefix."""
        import obstore

        with one_line():
            objects = chain.from_iterable(obstore.list(self.store, prefix))
            return {meta["path"]: meta["size"] for meta in objects}


@contextmanager
def one_line() -> Iterator[None]:
    """Convert errors of the server or the network into one line."""
    from obstore.exceptions import BaseError

    try:
        yield
    except BaseError as error:
        raise StoreError(str(error).splitlines()[0]) from None


@cache
def bucket(url: str) -> Bucket:
    """Return the store at a URL, with one client for the whole process."""
    return Bucket(url.rstrip("/"))


def _plain_http() -> bool:
    """Return whether the server's address is one without encryption."""
    return os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
