"""Where a page is found, and whether a request came by its own name: what no other page in the browser can pretend."""

import re
import socket
from collections.abc import Collection

from starlette.datastructures import Headers

LOCAL = frozenset({"127.0.0.1", "localhost", "[::1]"})


def is_stranger(headers: Headers, names: Collection[str]) -> bool:
    """Whether the request came by another name than ours, or from another page."""
    hosts, origin = headers.getlist("host"), headers.get("origin")
    if len(hosts) != 1 or re.sub(r":\d+$", "", hosts[0]).lower() not in names:
        return True
    return origin is not None and origin not in {f"http://{hosts[0]}", f"https://{hosts[0]}"}


def listening(address: str, port: int) -> socket.socket:
    """A socket at an address; OSError where it is taken."""
    sock = socket.socket(socket.AF_INET6 if ":" in address else socket.AF_INET)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((address, port))
    sock.listen()  # who comes before the server is ready waits
    return sock
