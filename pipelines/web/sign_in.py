"""Identify the person behind a request: by the token the command prints, or by a header of the site's proxy.

`roles.toml` of a home sets who may read or change which operators' cases on the page. A viewer reads, an engineer also
changes cases. A person with `operators` reads those operators' cases only.
"""

import os
import re
import secrets
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from ipaddress import IPv4Network, IPv6Network, ip_address
from pathlib import Path
from typing import Any

from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response

from pipelines.storage.objects import StoreError
from pipelines.storage.settings import read_values
from pipelines.web.html import html_page

FILE = "roles.toml"
ROLES = ("viewer", "engineer")
_MAX_NAME = 80


@dataclass(frozen=True, slots=True)
class Person:
    """A signed-in person; an empty `operators` stands for all of them."""

    name: str
    role: str = "engineer"
    operators: tuple[str, ...] = ()

    @property
    def may_change(self) -> bool:
        """Test for a role that changes cases."""
        return self.role == "engineer"

    def may_read(self, operator: str) -> bool:
        """Test whether the person may read an operator's cases."""
        return not self.operators or operator in self.operators


def read_people(home: Path) -> dict[str, Person]:
    """Return everybody below `[people]`, by name; nobody where there is no file.

    Raises
    ------
    StoreError
        The file can't be read, or an entry is unknown or invalid; one line that names it.
    """
    return {name: _person(name, entry) for name, entry in _read_file(home)["people"].items()}


def local_person(home: Path) -> Person:
    """Return the person of the printed token: this account, an engineer unless `local` sets another role.

    Raises
    ------
    StoreError
        As `read_people`.
    """
    return _person(os.environ.get("USER", "").strip() or "local", _read_file(home)["local"])


def _read_file(home: Path) -> dict[str, Any]:
    entries = {"local": "engineer", "people": {}} | read_values(home / FILE, ("local", "people"))
    if not isinstance(entries["people"], dict):
        raise StoreError(f"{FILE}: people is a table of names; write [people] on a line of its own")
    return entries


def _person(name: str, entry: Any) -> Person:
    """Check one entry: a role, or a table of `role` and `operators`."""
    where = f"{FILE}: {name!r}"
    entry = entry if isinstance(entry, dict) else {"role": entry}
    if not (0 < len(name) <= _MAX_NAME and name.isprintable() and name == name.strip()):
        raise StoreError(f"{where}: a name has 1 to {_MAX_NAME} printable characters")
    if unknown := sorted(set(entry) - {"role", "operators"}):
        raise StoreError(f"{where}: unknown key {unknown[0]}; there are role and operators")
    role = entry.get("role")
    operators = entry.get("operators", [])
    if role not in ROLES:
        raise StoreError(f"{where}: role is {' or '.join(ROLES)}, not {role!r}")
    if not isinstance(operators, list) or not all(isinstance(o, str) for o in operators):
        raise StoreError(f"{where}: operators is a list of texts, not {operators!r}")
    if "operators" in entry and not operators:
        raise StoreError(f"{where}: operators is empty; leave it out to allow all of them")
    return Person(name, role, tuple(operators))


SignIn = Callable[[HTTPConnection], Person | Response]
"""Returns the person, or the answer to a request without one."""
HOURS, SESSIONS = 8, 100
"""Length of a session [h], and the number open at once; a further one ends the oldest."""
Network = IPv4Network | IPv6Network


class LocalToken:
    """Sign-in by a token drawn at each start; a session cookie then takes its place.

    Parameters
    ----------
    person : Person
        The token's holder.
    https : bool
        Restrict the cookie to https.
    """

    def __init__(self, person: Person, https: bool = False) -> None:
        self.person, self.https, self.token = person, https, secrets.token_urlsafe(32)
        self._ends: dict[str, float] = {}  # monotonic time [s] at which each session ends

    def __call__(self, request: HTTPConnection) -> Person | Response:
        """Start, continue or end a session."""
        cookie = _cookie_name(request)
        method = request.scope.get("method")
        if method == "GET" and "token" in request.query_params:
            return self._begin(request, cookie)
        session = request.cookies.get(cookie, "")
        if self._ends.get(session, 0.0) < time.monotonic():
            return _sign_in_page(401, "")
        if request.scope["path"] == "/logout" and method == "POST":
            del self._ends[session]
            response = _sign_in_page(200, "Signed out.")
            response.delete_cookie(cookie)
            return response
        return self.person

    def _begin(self, request: HTTPConnection, cookie: str) -> Response:
        """Set the session cookie and redirect to the address without the token."""
        if not secrets.compare_digest(request.query_params["token"].encode(), self.token.encode()):
            return _sign_in_page(403, "That is not the token of this start.")
        while len(self._ends) >= SESSIONS:
            del self._ends[next(iter(self._ends))]
        session = secrets.token_urlsafe(32)
        self._ends[session] = time.monotonic() + HOURS * 3600
        path = "/" + request.scope["path"].lstrip("/")  # a path with two slashes would redirect to another machine
        response = RedirectResponse(path, 303, {"cache-control": "no-store"})
        response.set_cookie(
            cookie, session, max_age=HOURS * 3600, httponly=True, samesite="strict", secure=self.https, path="/"
        )
        return response


class ProxyHeader:
    """Sign-in by the name that the site's proxy writes into a header.

    Parameters
    ----------
    home : Path
        Holds the roles, which are read with every request.
    header : str
        Header of the name; the proxy overwrites what its own caller sent in it.
    proxies : collection of networks
        Addresses of the proxies; requests from other addresses are refused.
    """

    def __init__(self, home: Path, header: str, proxies: Collection[Network]) -> None:
        self.home, self.header, self.proxies = home, header, tuple(proxies)

    def __call__(self, request: HTTPConnection) -> Person | Response:
        """Return the named person, or a page with the reason of the refusal."""
        if not self._is_proxy(request.client.host if request.client else ""):
            return _message_page(403, "This page answers the site's proxy only.")
        names = request.headers.getlist(self.header)
        if len(names) != 1 or not names[0].strip():
            return _message_page(401, "The site's proxy sent no name.")
        name = _decode_name(names[0].strip())
        try:
            person = read_people(self.home).get(name)
        except StoreError as error:
            return _message_page(503, f"{error}.")
        return person or _message_page(403, f"{name} has no role here.")

    def _is_proxy(self, address: str) -> bool:
        try:
            host = ip_address(address.partition("%")[0])
        except ValueError:
            return False
        host = getattr(host, "ipv4_mapped", None) or host
        return any(host in network for network in self.proxies)


def _cookie_name(request: HTTPConnection) -> str:
    """Name the cookie by port, since a browser shares cookies among all ports of a host."""
    port = re.search(r":(\d+)$", request.headers.get("host", ""))
    return f"hdt_session_{port[1]}" if port else "hdt_session"


def _decode_name(name: str) -> str:
    """Decode a header's latin-1 text as UTF-8 where that is possible."""
    try:
        return name.encode("latin-1").decode("utf-8")
    except UnicodeDecodeError:
        return name


def _sign_in_page(status: int, message: str) -> Response:
    return html_page("sign_in.html", status, title="Sign in", message=message)


def _message_page(status: int, message: str) -> Response:
    return html_page("message.html", status, title="Cases", message=message)
