"""Whatever the bytes: nothing raises, every row is accounted for."""

import io
from datetime import UTC, datetime
from pathlib import Path

import polars as pl
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.intake.landing import list_landing
from pipelines.intake.logs import read_fleet, read_maintenance, read_messages
from pipelines.intake.snapshots import read_snapshots

SAMPLES = Path(__file__).parents[3] / "data_samples"
NOW = datetime(2026, 1, 1, tzinfo=UTC)
CSV = "AQX/LX-AAA/acms/LX-AAA_20240525_04.csv"
quick = settings(max_examples=100, deadline=None, suppress_health_check=list(HealthCheck))

WORDS = b'\x00 \xff " "" , \n \r \r\n ; nan -inf 1e999 =1 \' 1_0 \xe2\x80\xae 0x1 flight_id \xef\xbb\xbf'
ODD = st.sampled_from([b" ", b"2024-02-30T00:00:00Z", *WORDS.split(b" ")])


@pytest.fixture(scope="module")
def zone(tmp_path_factory):
    root = tmp_path_factory.mktemp("zone")
    (root / CSV).parent.mkdir(parents=True)
    return root


@st.composite
def mutilated(draw, content: bytes) -> bytes:
    """`content` with a few pieces cut out, doubled or overwritten."""
    for _ in range(draw(st.integers(1, 6))):
        start = draw(st.integers(0, len(content)))
        stop = min(len(content), start + draw(st.sampled_from([0, 1, 2, 7, 40, 200])))
        piece = draw(st.one_of(ODD, st.just(b""), st.just(content[start:stop] * 2), st.binary(max_size=12)))
        content = content[:start] + piece + content[stop:]
    return content


@quick
@given(data=st.data())
def test_mutilated_csv_is_accounted_for(data, zone, good_flight, balanced):
    content = data.draw(mutilated(good_flight))
    (zone / CSV).write_bytes(content)
    intake = balanced(read_snapshots(list_landing(zone).files))
    if not set(intake.quarantine["scope"]) & {"file"} and b"\r" not in content:
        _, *rows = content.split(b"\n")
        assert intake.delivered["n_delivered"].sum() == sum(1 for line in rows if line.strip())


@quick
@given(content=st.binary(max_size=400))
def test_any_bytes_are_accounted_for(content, zone, balanced):
    (zone / CSV).write_bytes(content)
    files = list_landing(zone).files
    balanced(read_snapshots(files))
    for read in (read_messages, read_maintenance, read_fleet):
        log = read(files[0], NOW)
        assert log.n_delivered == log.rows.height + log.n_duplicate + log.quarantine["n_rows"].sum()


@quick
@given(data=st.data())
def test_mutilated_logs_are_accounted_for(data, zone):
    message = b"2024-05-02T18:51:18Z,LX-AAA_20240502_03,1,21-52-H,HOT\n"
    logs = {
        read_messages: (b"message_time,flight_id,pack,code,text\n", message),
        read_maintenance: (b"done_on,pack,component,action,finding,reference\n", b"2024-05-03,1,HX,REPLACED,,W1\n"),
        read_fleet: (b"operator,tail,msn,delivered_on,packs\n", b"AQX,LX-AAA,40000,2014-06-01,2\n"),
    }
    for read, (header, row) in logs.items():
        (zone / CSV).write_bytes(data.draw(mutilated(header + 2 * row)))
        log = read(list_landing(zone).files[0], NOW)
        assert log.n_delivered == log.rows.height + log.n_duplicate + log.quarantine["n_rows"].sum()
        assert log.n_duplicate >= 0


@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_mutilated_parquet_is_accounted_for(data, tmp_path_factory, history, balanced):
    root = tmp_path_factory.mktemp("zone")
    path = root / "AQX/LX-AAA/acms/history_2024-05.parquet"
    path.parent.mkdir(parents=True)
    spoiled = bytearray(history)
    for _ in range(data.draw(st.integers(1, 8))):
        spoiled[data.draw(st.integers(0, len(spoiled) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(spoiled)[: data.draw(st.sampled_from([len(spoiled)] * 5 + [len(spoiled) // 2]))])
    balanced(read_snapshots(list_landing(root).files))


@pytest.fixture(scope="module")
def history(good_flight):
    frame = pl.read_csv(good_flight).to_arrow()
    sink = io.BytesIO()
    pq.write_table(frame, sink, compression="zstd", write_page_checksum=True)
    return sink.getvalue()


def test_sample_fleet_has_no_fault(read):
    """0 of 395,012 good rows kept aside, frozen, spiked and dropped-out sensors included."""
    files = [f for f in list_landing(SAMPLES).files if f.kind in ("acms", "history", "cpl")]
    intake = read(files)
    assert intake.delivered["n_delivered"].sum() == 395_012
    assert intake.quarantine.is_empty()


def test_batch_changes_no_row(read):
    files = [f for f in list_landing(SAMPLES).files if f.tail == "A9-BAB" and f.kind == "acms"]
    together = read(files).rows
    alone = pl.concat([read(f).rows for f in files])
    assert together.sort("file", "row_in_file").equals(alone.sort("file", "row_in_file"))
