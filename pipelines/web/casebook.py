"""The page of cases: who is logged in sees the open cases of the operators that are theirs, and may change them.

Everything it shows is read from the catalog and the log of cases, read only; the one thing it writes is a line of that
log. No script runs in it.
"""

import re
import secrets
import socket
from collections.abc import Awaitable, Callable, Collection
from functools import cache
from pathlib import Path
from typing import Any

import uvicorn
from jinja2 import Environment
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData
from starlette.middleware import Middleware
from starlette.middleware.sessions import SessionMiddleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, RedirectResponse, Response
from starlette.routing import Route

from pipelines.casework.changes import DONE, FOUND, KINDS, change_case
from pipelines.casework.listing import OPEN, find_case, history_of, list_cases, outlook_of
from pipelines.report import words
from pipelines.report.templating import source_hash, templates_of
from pipelines.storage.cases import ConflictError
from pipelines.web.address import LOCAL
from pipelines.web.guard import Guard, Guesses
from pipelines.web.people import Person, people, person_of, session_secret

_POLICY = "default-src 'none'; style-src {}; img-src data:; form-action 'self'; frame-ancestors 'none'; base-uri 'none'"
HOURS = 8
"""How long a session lasts."""
_ASKED = ("note", "assignee", "until", "finding", "action", "on", "reference")
Answer = Callable[[Request, Person], Awaitable[Response]]


def serve_cases(home: Path, sock: socket.socket, names: tuple[str, ...] = (), https: bool = False) -> None:
    """Serve the page until someone stops it."""
    app = application(home, LOCAL | set(names), https)
    config = uvicorn.Config(app, log_level="warning", server_header=False, proxy_headers=False)
    uvicorn.Server(config).run(sockets=[sock])


def application(home: Path, names: Collection[str], https: bool = False) -> Starlette:
    """The page for who comes by one of the `names`.

    Parameters
    ----------
    home : Path
        Holds catalog, log of cases, users and the secret that sessions are signed with.
    names : collection of str
        Names, without a port, by which this machine or the proxy before it is called.
    https : bool
        Whether browsers come by https: the cookie is then sent by nothing else.
    """
    session = Middleware(
        SessionMiddleware, secret_key=session_secret(home), session_cookie="hdt_session", max_age=HOURS * 3600,
        same_site="strict", https_only=https,
    )  # fmt: skip
    casebook = Casebook(home)
    routes = [
        Route("/login", casebook.ask_in, methods=["GET"]),
        Route("/login", casebook.let_in, methods=["POST"]),
        Route("/logout", casebook.known(casebook.out, changes=True), methods=["POST"]),
        Route("/", casebook.known(casebook.list), methods=["GET"]),
        Route("/case/{alert_id:str}", casebook.known(casebook.show), methods=["GET"]),
        Route("/case/{alert_id:str}", casebook.known(casebook.change, changes=True), methods=["POST"]),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard, names=names), session])


class Casebook:
    """Answers of one home's page."""

    def __init__(self, home: Path) -> None:
        self.home, self.guesses = home, Guesses()

    def known(self, answer: Answer, *, changes: bool = False) -> Callable[[Request], Awaitable[Response]]:
        """`answer` for who is logged in; what changes anything must bring the session's own token."""

        async def asked(request: Request) -> Response:
            person = self._person(request)
            if person is None:
                request.session.clear()
                return RedirectResponse("/login", 303)
            if changes and not await _brings_token(request):
                return _told(request, person, 403, "This form is not of your session; load the page again.")
            return await answer(request, person)

        return asked

    def _person(self, request: Request) -> Person | None:
        person = people(self.home).get(str(request.session.get("name")))
        return person if person and person.stamp == request.session.get("stamp") else None

    async def ask_in(self, request: Request) -> Response:
        """The form to log in with."""
        return _login(request)

    async def let_in(self, request: Request) -> Response:
        """Log in: a session of its own begins, whatever was in the cookie before."""
        form = await request.form()
        name, password = _word(form, "name"), str(form.get("password") or "")
        address = request.client.host if request.client else ""
        if self.guesses.too_many(name, address):
            return _login(request, 429, "Too many wrong passwords; wait five minutes.")
        self.guesses.note(name, address)  # before it is tried: many at once are many guesses
        person = await run_in_threadpool(person_of, self.home, name, password) if await _brings_token(request) else None
        if person is None:
            return _login(request, 401, "Name and password do not belong together.")
        self.guesses.forget(name)
        request.session.clear()
        request.session.update(name=person.name, stamp=person.stamp, token=secrets.token_urlsafe(24))
        return RedirectResponse("/", 303)

    async def out(self, request: Request, person: Person) -> Response:
        """Log out."""
        request.session.clear()
        return RedirectResponse("/login", 303)

    async def list(self, request: Request, person: Person) -> Response:
        """The open cases, or all, of the person's operators."""
        every = "all" in request.query_params
        mine = "(len($operators::varchar[]) = 0 or list_contains($operators::varchar[], c.operator))"
        where = mine if every else f"{OPEN} and {mine}"
        found = await run_in_threadpool(list_cases, self.home, where, {"operators": list(person.operators)})
        return _page("cases.html", title="Cases", person=person, token=_token(request), cases=found, every=every)

    async def show(self, request: Request, person: Person) -> Response:
        """One case."""
        return await self._case(request, person)

    async def change(self, request: Request, person: Person) -> Response:
        """Write a line about a case."""
        case = await self._found(request, person)
        if case is None:
            return _none(request, person)
        if not person.may_change:
            return _told(request, person, 403, "A viewer changes nothing; ask an engineer.")
        form = await request.form()
        kind, seen = _word(form, "kind"), _word(form, "seen")
        if kind not in KINDS or not seen.isdecimal():
            return _told(request, person, 400, "There is nothing of that kind to do.")
        asked = {k: _word(form, k) or None for k in _ASKED}
        try:
            said = await run_in_threadpool(
                lambda: change_case(self.home, case["alert_id"], kind, person.name, int(seen), **asked)
            )
        except ConflictError as error:
            return await self._case(request, person, 409, f"Nothing was written: {error}.")
        except ValueError as error:
            return await self._case(request, person, 422, f"Nothing was written: {error}.")
        return await self._case(request, person, said=said)

    async def _found(self, request: Request, person: Person) -> dict[str, Any] | None:
        """The case that the address names in full, if it is the person's to see."""
        name = request.path_params["alert_id"]
        try:
            case = await run_in_threadpool(find_case, self.home, name)
        except LookupError:
            return None
        return case if case["alert_id"] == name and person.sees(case["operator"]) else None

    async def _case(self, request: Request, person: Person, status: int = 200, said: str = "") -> Response:
        case = await self._found(request, person)
        if case is None:
            return _none(request, person)
        told = await run_in_threadpool(history_of, self.home, case["alert_id"])
        due, choices = await run_in_threadpool(outlook_of, self.home, case)
        title = f"{case['tail']} pack {case['pack']}: {case['diagnosis']}"
        return _page(
            "case.html", status, title=title, person=person, token=_token(request), case=case, told=told, said=said,
            found=list(FOUND), done=DONE, due=due, choices=choices,
        )  # fmt: skip


def _login(request: Request, status: int = 200, said: str = "") -> Response:
    return _page("login.html", status, title="Log in", token=_token(request), said=said)


def _none(request: Request, person: Person) -> Response:
    """The same for a case that there is not and for one of another operator."""
    return _told(request, person, 404, "There is no such case.")


def _told(request: Request, person: Person, status: int, said: str) -> Response:
    return _page("told.html", status, title="Cases", person=person, token=_token(request), said=said)


def _token(request: Request) -> str:
    """The session's token, which every form brings back."""
    return str(request.session.setdefault("token", secrets.token_urlsafe(24)))


async def _brings_token(request: Request) -> bool:
    held, brought = str(request.session.get("token") or ""), _word(await request.form(), "token")
    return bool(held) and secrets.compare_digest(held.encode(), brought.encode())


def _word(form: FormData, name: str) -> str:
    value = form.get(name)
    return value.strip() if isinstance(value, str) else ""


def _page(template: str, status: int = 200, **context: Any) -> HTMLResponse:
    """A page; nothing in it runs, and nothing is fetched for it."""
    html = _environment().get_template(template).render(language="en", **context)
    (style,) = re.findall(r"<style>(.*?)</style>", html, flags=re.DOTALL)
    return HTMLResponse(html, status, {"content-security-policy": _POLICY.format(source_hash(style))})


@cache
def _environment() -> Environment:
    made = templates_of("pipelines.web", "pipelines.report")
    made.filters["plainly"] = words.diagnosis
    return made
