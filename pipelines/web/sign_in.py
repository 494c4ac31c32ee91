"""Who asks: by the one token that the command prints, or by a header that the site's proxy sets."""

import re
import secrets
import time
from collections.abc import Callable, Collection
from ipaddress import IPv4Network, IPv6Network, ip_address
from pathlib import Path

from starlette.requests import HTTPConnection
from starlette.responses import RedirectResponse, Response

from pipelines.web.html import html_page
from pipelines.web.roles import Person, RolesError, read_people

SignIn = Callable[[HTTPConnection], Person | Response]
"""Says who sends a request, or what it is answered where nobody may."""
HOURS, SESSIONS = 8, 100
"""How long a session lasts [h], and how many are open at once: the oldest gives way."""
Network = IPv4Network | IPv6Network


class LocalToken:
    """Signs in who brings the token, which is another at each start; a session of its own goes on without it.

    Parameters
    ----------
    person : Person
        Who comes with the token.
    https : bool
        Whether browsers come by https: the cookie is then sent by nothing else.
    """

    def __init__(self, person: Person, https: bool = False) -> None:
        self.person, self.https, self.token = person, https, secrets.token_urlsafe(32)
        self._ends: dict[str, float] = {}  # of each session

    def __call__(self, request: HTTPConnection) -> Person | Response:
        """Begin, use or end a session."""
        cookie, method = _cookie_name(request), request.scope.get("method")
        if method == "GET" and "token" in request.query_params:
            return self._begin(request, cookie)
        session = request.cookies.get(cookie, "")
        if self._ends.get(session, 0.0) < time.monotonic():
            return _sign_in_page(401, "")
        if request.scope["path"] == "/logout" and method == "POST":
            del self._ends[session]
            answer = _sign_in_page(200, "Signed out.")
            answer.delete_cookie(cookie)
            return answer
        return self.person

    def _begin(self, request: HTTPConnection, cookie: str) -> Response:
        """Give the browser a session, and an address without the token."""
        if not secrets.compare_digest(request.query_params["token"].encode(), self.token.encode()):
            return _sign_in_page(403, "That is not the token of this start.")
        while len(self._ends) >= SESSIONS:
            del self._ends[next(iter(self._ends))]
        session = secrets.token_urlsafe(32)
        self._ends[session] = time.monotonic() + HOURS * 3600
        path = "/" + request.scope["path"].lstrip("/")  # two slashes would lead to another machine
        answer = RedirectResponse(path, 303, {"cache-control": "no-store"})
        answer.set_cookie(
            cookie, session, max_age=HOURS * 3600, httponly=True, samesite="strict", secure=self.https, path="/"
        )
        return answer


class ProxyHeader:
    """Signs in whom a header names, where one of the site's proxies sends it.

    Parameters
    ----------
    home : Path
        Holds the roles, which are read with every request.
    header : str
        What the proxy writes the name into, whatever its own caller sent there.
    proxies : collection of networks
        Addresses the proxies send from; who comes from elsewhere is refused.
    """

    def __init__(self, home: Path, header: str, proxies: Collection[Network]) -> None:
        self.home, self.header, self.proxies = home, header, tuple(proxies)

    def __call__(self, request: HTTPConnection) -> Person | Response:
        """The person with a role, or why there is none."""
        if not self._is_proxy(request.client.host if request.client else ""):
            return _notice(403, "This page is reached through the site's proxy only.")
        names = request.headers.getlist(self.header)
        if len(names) != 1 or not names[0].strip():
            return _notice(401, "The site's proxy names nobody.")
        name = _decoded(names[0].strip())
        try:
            person = read_people(self.home).get(name)
        except RolesError as error:
            return _notice(503, f"{error}.")
        return person or _notice(403, f"{name} has no role here.")

    def _is_proxy(self, address: str) -> bool:
        try:
            place = ip_address(address.partition("%")[0])
        except ValueError:
            return False
        place = getattr(place, "ipv4_mapped", None) or place
        return any(place in network for network in self.proxies)


def _cookie_name(request: HTTPConnection) -> str:
    """Of the port, too: to a browser all ports of this machine are one place for cookies."""
    port = re.search(r":(\d+)$", request.headers.get("host", ""))
    return f"hdt_session_{port[1]}" if port else "hdt_session"


def _decoded(name: str) -> str:
    """A header's value, which comes as latin-1 and is UTF-8 where it can be."""
    try:
        return name.encode("latin-1").decode("utf-8")
    except UnicodeDecodeError:
        return name


def _sign_in_page(status: int, message: str) -> Response:
    return html_page("sign_in.html", status, title="Sign in", message=message)


def _notice(status: int, message: str) -> Response:
    return html_page("message.html", status, title="Cases", message=message)
