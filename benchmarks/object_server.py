"""A real S3 server for tests and benchmarks: SeaweedFS, on the local host, with ports and a folder of its own."""

import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

SERVER = shutil.which("weed", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
_PARTS = ("master.port", "volume.port", "filer.port", "s3.port")
_KEYS = {"AWS_ACCESS_KEY_ID": "tests", "AWS_SECRET_ACCESS_KEY": "only-for-tests", "AWS_REGION": "us-east-1"}
METRICS = "HDT_TEST_S3_METRICS"
BUCKET = "fleets"


@contextmanager
def serving(folder: Path, patience_s: float = 60.0) -> Iterator[dict[str, str]]:
    """The variables by which a client finds the server and may write to it, while it runs."""
    ports = dict(zip((*_PARTS, *(f"{p}.grpc" for p in _PARTS), "metricsPort"), _free(2 * len(_PARTS) + 1), strict=True))
    where = ["-ip=127.0.0.1", "-ip.bind=127.0.0.1", f"-dir={folder}", *(f"-{p}={n}" for p, n in ports.items())]
    size = ["-master.volumeSizeLimitMB=64", "-volume.max=50", "-s3.port.iceberg=0", "-s3.port.lance=0"]
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "log", "wb") as log:
        command = [SERVER, "-logtostderr", "server", "-filer", "-s3", *where, *size]
        server = subprocess.Popen(command, env=os.environ | _KEYS, stdout=log, stderr=log)
    address = f"http://127.0.0.1:{ports['s3.port']}"
    try:
        _wait(address, server, time.monotonic() + patience_s)
        _make_bucket(address)
        yield {**_KEYS, "AWS_ENDPOINT_URL": address, METRICS: f"http://127.0.0.1:{ports['metricsPort']}/metrics"}
    finally:
        server.kill()
        server.wait()
        for socket_file in (f for n in ports.values() for f in Path("/tmp").glob(f"seaweedfs-*-{n}.sock")):
            socket_file.unlink()


def _make_bucket(address: str) -> None:
    """The server makes a bucket with its first object."""
    import obstore  # noqa: PLC0415  the extra s3
    from obstore.store import S3Store  # noqa: PLC0415

    how = {k.removeprefix("AWS_").lower(): v for k, v in _KEYS.items()} | {"endpoint": address}
    obstore.put(S3Store(BUCKET, **how, client_options={"allow_http": True}), "here", b"")


def requests() -> dict[str, int]:
    """How many requests of each kind the server has answered, by its own count."""
    with urllib.request.urlopen(os.environ[METRICS]) as page:
        metrics = page.read().decode()
    counts: dict[str, int] = {}
    for kind, n in re.findall(r'^SeaweedFS_s3_request_total\{.*?type="(\w+)".*?\} (\S+)$', metrics, flags=re.MULTILINE):
        counts[kind] = counts.get(kind, 0) + int(float(n))
    return counts


def _free(n: int) -> list[int]:
    """Ports nobody uses."""
    sockets = [socket.create_server(("127.0.0.1", 0)) for _ in range(n)]
    ports = [s.getsockname()[1] for s in sockets]
    for s in sockets:
        s.close()
    return ports


def _wait(address: str, server: subprocess.Popen[bytes], until: float) -> None:
    """Until the server answers, be it with a refusal."""
    while time.monotonic() < until and server.poll() is None:
        try:
            with urllib.request.urlopen(f"{address}/status", timeout=1):
                return
        except urllib.error.HTTPError:
            return
        except OSError:
            time.sleep(0.1)
    raise RuntimeError("the S3 server did not start")
