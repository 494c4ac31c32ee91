"""An object store as the place of the tables: S3, or a server that speaks its language.

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
    """What keeps the tables from being read or written, in one line."""


@dataclass(frozen=True)
class Bucket:
    """Tables as objects below one URL, `s3://bucket/prefix`."""

    url: str
    remote: ClassVar[bool] = True
    doubted: ClassVar[bool] = False
    """A store looks after its own sums, and no night makes an object again."""

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
        """What a reader or a writer of the objects must be told beside their names.

        A commit is put on condition that there is none of its number: of two writers the second is refused.
        """
        return {"aws_allow_http": str(_plain_http()).lower(), "aws_conditional_put": "etag"}

    def get(self, path: str) -> bytes:
        """An object whole."""
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

    def doubt(self) -> None:
        """Nothing: see `doubted`."""

    trust = doubt

    def newest_commit(self, table: str) -> tuple[str, int, int] | None:
        """Nothing: to ask for it would take as long as to open the table."""

    def settle(self, table: str, version: int) -> None:
        """What a store has accepted is safe."""

    def sweep(self) -> int:
        """A killed writer leaves nothing that is not whole; what no table names goes with the next vacuum."""
        return 0

    def sizes(self, prefix: str) -> dict[str, int]:
        """Bytes of each object below a prefix."""
        import obstore

        with one_line():
            found = chain.from_iterable(obstore.list(self.store, prefix))
            return {meta["path"]: meta["size"] for meta in found}


@contextmanager
def one_line() -> Iterator[None]:
    """What the server or the network says, in one line."""
    from obstore.exceptions import BaseError

    try:
        yield
    except BaseError as error:
        raise StoreError(str(error).splitlines()[0]) from None


@cache
def bucket(url: str) -> Bucket:
    """The store at a URL, with the one client this process needs for it."""
    return Bucket(url.rstrip("/"))


def _plain_http() -> bool:
    """Only a server named by an address without encryption is spoken to without."""
    return os.environ.get("AWS_ENDPOINT_URL", "").startswith("http://")
