"""Open recordings and parameter maps, decode them and write Parquet."""

import lzma
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from hdt_recorder.decoding.decode import Series
from hdt_recorder.decoding.fit import decode, recognise
from hdt_recorder.decoding.frames_767 import Recording767
from hdt_recorder.decoding.layout import MapError, Parameter, ParameterMap
from hdt_recorder.decoding.plain_map import read_csv, read_toml
from hdt_recorder.decoding.printed import ReportLine
from hdt_recorder.decoding.timeline_717 import Recording717
from hdt_recorder.decoding.vec_map import read_vec
from hdt_recorder.decoding.xml_map import read_xml
from pipelines.storage.files import replacing

_TEXT = pa.dictionary(pa.int32(), pa.string())
SCHEMA = pa.schema({"parameter": _TEXT, "t_s": pa.float64(), "value": pa.float64(), "text": _TEXT})
REPORT_SCHEMA = {
    "report": pl.Int32, "number": pl.String, "line": pl.Int32, "row": pl.String, "name": pl.String,
    "value": pl.Float64, "text": pl.String,
}  # fmt: skip
HOW: dict[str, Any] = {
    "compression": "zstd",
    "compression_level": 1,
    "use_dictionary": ["parameter", "text", "value"],
    "column_encoding": {"t_s": "BYTE_STREAM_SPLIT"},  # a quarter of the size, and faster, for numbers that only grow
    "store_schema": False,
}
ROWS_OF_A_GROUP = 1 << 20
_UNREADABLE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, NotImplementedError, RuntimeError)
"""Errors of an archive that is damaged, encrypted or packed by another method."""
MOST_BYTES = 512 << 20
"""Bytes that a recording, or all members of a map, may have; a ten-hour recording of 2,048 words a second has 150
million."""


@dataclass(frozen=True, slots=True)
class DecodeResult:
    """Counts of what was written: parameters, rows, and rows that have neither value nor text."""

    parameters: int
    rows: int
    nulls: int


def read_map(path: Path) -> ParameterMap:
    """Read a map: `.vec` archive, ARINC 647A XML, or our own TOML or CSV. Raises `MapError`, which names the file."""
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                parts = [i for i in archive.infolist() if i.filename.lower().endswith((".par", ".fra", ".frd"))]
                _check_size(sum(i.file_size for i in parts))
                return read_vec({i.filename: archive.read(i) for i in parts})
        _check_size(path.stat().st_size)
        data = path.read_bytes()
        if data.lstrip()[:1] == b"<" or path.suffix.lower() == ".xml":
            return read_xml(data)
        return (read_csv if path.suffix.lower() == ".csv" else read_toml)(data.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise MapError(f"{path.name}: neither an archive, nor XML, nor text in UTF-8") from None
    except (MapError, *_UNREADABLE) as error:
        raise MapError(f"{path.name}: {error}") from None


def unpacked_bytes(path: Path) -> int:
    """Return the size of a recording, of an archive that of its largest member as declared; 0 where unreadable."""
    try:
        if not zipfile.is_zipfile(path):
            return path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            return max((i.file_size for i in archive.infolist()), default=0)
    except (OSError, zipfile.BadZipFile):
        return 0


def read_recording(path: Path, member: str = "") -> npt.NDArray[np.uint8]:
    """Return the bytes of a recording; of an archive, those of `member` if it has it, else of its largest."""
    try:
        if not zipfile.is_zipfile(path):
            _check_size(path.stat().st_size)
            return np.fromfile(path, np.uint8)
        with zipfile.ZipFile(path) as archive:
            entry = max(archive.infolist(), key=lambda i: (i.filename == member, i.file_size))
            _check_size(entry.file_size)
            return np.frombuffer(archive.read(entry), np.uint8)
    except (MapError, ValueError, *_UNREADABLE) as error:
        raise MapError(f"{path.name}: {error}") from None


def _check_size(n_bytes: int) -> None:
    if n_bytes > MOST_BYTES:
        raise MapError(f"{n_bytes:,} bytes; {MOST_BYTES:,} are allowed")


def open_recording(file: Path, map_file: Path) -> tuple[Recording717 | Recording767, ParameterMap]:
    """Open a recording and the map that fits it. Raises `MapError`, which names what disagrees."""
    layout = read_map(map_file)
    try:
        return recognise(read_recording(file), layout), layout
    except MapError as error:
        raise MapError(f"{map_file.name} does not fit {file.name}: {error}") from None


def report_rows(lines: Iterable[ReportLine]) -> pl.DataFrame:
    """Return lines of printed reports as rows: a value each, in `value` or in `text`."""
    rows = [
        (x.report, x.number, x.line, x.row, name, *((None, value) if isinstance(value, str) else (value, None)))
        for x in lines
        for name, value in x.values.items()
    ]
    return pl.DataFrame(rows, schema=REPORT_SCHEMA, orient="row")


def write_decoded(
    recording: Recording717 | Recording767, parameters: Iterable[Parameter], target: Path
) -> DecodeResult:
    """Write `parameter, t_s, value, text`, parameter by parameter, in order of time."""
    count = rows = nulls = 0
    tables: list[pa.Table] = []
    with replacing(target) as temporary, pq.ParquetWriter(temporary, SCHEMA, **HOW) as writer:
        for series in decode(recording, parameters):
            tables.append(_table(series))
            count = count + 1
            rows = rows + series.t_s.size
            nulls = nulls + int((~series.valid).sum())
            if sum(t.num_rows for t in tables) >= ROWS_OF_A_GROUP:
                writer.write_table(pa.concat_tables(tables).unify_dictionaries())
                tables = []
        if tables:
            writer.write_table(pa.concat_tables(tables).unify_dictionaries())
    return DecodeResult(count, rows, nulls)


def _table(series: Series) -> pa.Table:
    n = series.t_s.size
    mask = ~series.valid
    name = pa.DictionaryArray.from_arrays(np.zeros(n, np.int32), [series.parameter.name])
    value = pa.nulls(n, pa.float64()) if series.value is None else pa.array(series.value, mask=mask)
    text = pa.nulls(n, SCHEMA.field("text").type)
    if series.text is not None:
        has_name = np.array([name is not None for name in series.text.names])
        codes = pa.array(series.text.codes, mask=mask | ~has_name[series.text.codes])
        text = pa.DictionaryArray.from_arrays(codes, pa.array([name or "" for name in series.text.names]))
    return pa.Table.from_arrays([name, pa.array(series.t_s), value, text], schema=SCHEMA)
