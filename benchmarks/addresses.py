"""Network namespaces with an address each, and a way from them to this machine's servers; needs root and iproute2."""

import asyncio
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

BRIDGE_IP = "10.77.0.1"
PORTS = (5432, 5672)
_BRIDGE = "hdtbr0"


@contextmanager
def namespaces(machines: tuple[str, ...]) -> Iterator[dict[str, str]]:
    """Create a namespace for each machine; empty where that is not permitted."""
    if not machines or os.geteuid() or not shutil.which("ip"):
        yield {}
        return
    names = {machine: f"hdt-{machine}" for machine in machines}
    _ip(f"link add {_BRIDGE} type bridge", f"address add {BRIDGE_IP}/24 dev {_BRIDGE}", f"link set {_BRIDGE} up")
    try:
        for k, name in enumerate(names.values(), 2):
            here, there = f"hdtv{k}", f"hdtp{k}"
            _ip(f"netns add {name}", f"link add {here} type veth peer name {there} netns {name}")
            _ip(f"link set {here} master {_BRIDGE}", f"link set {here} up")
            inside = (f"address add 10.77.0.{k}/24 dev {there}", f"link set {there} up", "link set lo up")
            _ip(*(f"-n {name} {word}" for word in inside))
        with forwarding():
            yield names
    finally:
        for name in names.values():
            with suppress(subprocess.CalledProcessError):
                _ip(f"netns delete {name}")
        _ip(f"link delete {_BRIDGE}")


def _ip(*words: str) -> None:
    for line in words:
        subprocess.run(["ip", *line.split()], check=True, capture_output=True, text=True)


@contextmanager
def forwarding() -> Iterator[None]:
    """Forward connections from the bridge to the servers, which listen on loopback only."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()

    async def serve() -> None:
        for port in PORTS:
            await asyncio.start_server(lambda r, w, p=port: _pass_on(r, w, p), BRIDGE_IP, port)

    asyncio.run_coroutine_threadsafe(serve(), loop).result(10)
    try:
        yield
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()


async def _pass_on(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, port: int) -> None:
    try:
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", port)
    except OSError:
        writer.close()
        return
    await asyncio.gather(_pump(reader, far_writer), _pump(far_reader, writer))


async def _pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    writer.close()
