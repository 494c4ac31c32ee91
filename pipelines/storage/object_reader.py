"""Let DuckDB read a store's objects: read only, and none but the tables' files."""

import io
import re
from datetime import UTC, datetime
from typing import Any

import fsspec
import obstore

from pipelines.storage.objects import Bucket

WHOLE_BYTES = 8 << 20  # a smaller object is read in one request, a larger one in ranges
CACHE_BYTES = 64 << 20  # cached in memory: DuckDB opens an object for its columns, and again for its rows
_KEY = re.compile(r"[a-z]\w*(/[\w-]+)*/[\w.-]+\.parquet")


class ObjectFiles(fsspec.AbstractFileSystem):  # type: ignore[misc]  # fsspec has no types
    """The tables' files in one store; they never change, so DuckDB may open one twice."""

    protocol = "s3"
    cachable = False

    def __init__(self, objects: Bucket) -> None:
        super().__init__()
        self._objects = objects
        self._root = objects.url.removeprefix("s3://") + "/"
        self._sizes: dict[str, int] = {}
        self._cache: dict[str, bytes] = {}

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        """Return name and size."""
        return {"name": path, "size": self._size(self._key(path)), "type": "file"}

    def modified(self, path: str) -> datetime:
        """Return the same time for all: an object never changes."""
        return datetime.fromtimestamp(0, UTC)

    def _open(self, path: str, mode: str = "rb", **_: Any) -> Any:
        if mode != "rb":
            raise PermissionError(f"{path} is read only")
        key = self._key(path)
        if self._size(key) > WHOLE_BYTES:
            return obstore.open_reader(self._objects.store, key, size=self._size(key))
        return io.BytesIO(self._whole(key))

    def _whole(self, key: str) -> bytes:
        content = self._cache.get(key)
        if content is None:
            if sum(len(other) for other in list(self._cache.values())) > CACHE_BYTES:
                self._cache = {}
            content = self._cache[key] = self._objects.get(key)
        return content

    def _key(self, path: str) -> str:
        key = str(self._strip_protocol(path)).removeprefix(self._root)
        if not _KEY.fullmatch(key):
            raise PermissionError(f"{path} is no object of the tables")
        return key

    def _size(self, key: str) -> int:
        """Size of an object in bytes, from one listing of its table."""
        if key not in self._sizes:
            self._sizes |= self._objects.sizes(key.partition("/")[0])
        if key not in self._sizes:
            raise FileNotFoundError(f"{key} is not in the store")
        return self._sizes[key]
