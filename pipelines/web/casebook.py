"""The page of cases: who is signed in sees the open cases of the operators that are theirs, and may change them.

Everything it shows is read from the catalog and the log of cases, read only; the one thing it writes is a line of that
log. No script runs in it.
"""

import re
import sqlite3
from collections.abc import Collection
from pathlib import Path
from typing import Any

import duckdb
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from pipelines.casework.board import Board, Row
from pipelines.casework.changes import DONE, FOUND, KINDS, change_case
from pipelines.storage.cases import ConflictError
from pipelines.storage.postgres import DatabaseError
from pipelines.web.guard import Guard
from pipelines.web.html import html_page
from pipelines.web.sign_in import LocalToken, SignIn

MAX_BODY = 64 << 10
_FIELDS = ("note", "assignee", "until", "finding", "action", "on", "reference")
_UNREADABLE = (OSError, DatabaseError, duckdb.Error, sqlite3.Error)


def application(home: Path, names: Collection[str], sign_in: SignIn) -> Guard:
    """The page of a home for who comes by one of the `names` and is signed in."""
    casebook = Casebook(home, may_leave=isinstance(sign_in, LocalToken))
    routes = [
        Route("/", casebook.list, methods=["GET"]),
        Route("/case/{alert_id:str}", casebook.show, methods=["GET"]),
        Route("/case/{alert_id:str}", casebook.change, methods=["POST"]),
    ]
    app = Starlette(routes=routes, exception_handlers=dict.fromkeys(_UNREADABLE, casebook.unreadable))
    return Guard(app, names, sign_in, MAX_BODY)


class Casebook:
    """Answers of one home's page.

    Parameters
    ----------
    home : Path
        Holds catalog and log of cases.
    may_leave : bool
        Whether a session is ours to end.
    """

    def __init__(self, home: Path, may_leave: bool) -> None:
        self.home, self.board, self.may_leave = home, Board(home), may_leave

    async def list(self, request: Request) -> Response:
        """The open cases, or all, of the person's operators."""
        person, every = request.state.person, "all" in request.query_params
        board = await run_in_threadpool(self.board.read)
        cases = [c for c in board.cases.values() if person.sees(c["operator"]) and (every or c["state"] != "closed")]
        return self._page(request, "cases.html", title="Cases", cases=cases, every=every)

    async def show(self, request: Request) -> Response:
        """One case."""
        return await self._case(request)

    async def change(self, request: Request) -> Response:
        """Write a line about a case."""
        case, person = await self._find(request), request.state.person
        if case is None:
            return self._none(request)
        if not person.may_change:
            return self._message(request, 403, "A viewer changes nothing; ask an engineer.")
        async with request.form(max_files=0) as form:
            kind, seen, fields = _word(form, "kind"), _word(form, "seen"), {k: _word(form, k) or None for k in _FIELDS}
        if kind not in KINDS or not re.fullmatch(r"[0-9]{1,18}", seen):
            return self._message(request, 400, "There is nothing of that kind to do.")
        try:
            message = await run_in_threadpool(
                lambda: change_case(self.home, case, kind, person.name, int(seen), **fields)
            )
        except ConflictError as error:
            return await self._case(request, 409, f"Nothing was written: {error}.")
        except ValueError as error:
            return await self._case(request, 422, f"Nothing was written: {error}.")
        return await self._case(request, message=message)

    async def unreadable(self, request: Request, error: Exception) -> Response:
        """Say in one line that there is nothing to show, and what mends it."""
        if isinstance(error, duckdb.CatalogException | duckdb.BinderException):
            return self._message(request, 503, "The catalog was made by an earlier version; the next night renews it.")
        return self._message(request, 503, f"{str(error).splitlines()[0]}.")

    async def _find(self, request: Request) -> Row | None:
        """The case that the address names in full, if it is the person's to see."""
        case = (await run_in_threadpool(self.board.read)).cases.get(request.path_params["alert_id"])
        return case if case and request.state.person.sees(case["operator"]) else None

    async def _case(self, request: Request, status: int = 200, message: str = "") -> Response:
        board, case = await run_in_threadpool(self.board.read), await self._find(request)
        if case is None:
            return self._none(request)
        due, choices = board.outlook.of(case)
        return self._page(
            request, "case.html", status, title=f"{case['tail']} pack {case['pack']}: {case['diagnosis']}", case=case,
            history=board.history.get(case["alert_id"], []), message=message, findings=list(FOUND), actions=DONE,
            due=due, choices=choices,
        )  # fmt: skip

    def _none(self, request: Request) -> Response:
        """The same for a case that there is not and for one of another operator."""
        return self._message(request, 404, "There is no such case.")

    def _message(self, request: Request, status: int, message: str) -> Response:
        return self._page(request, "message.html", status, title="Cases", message=message)

    def _page(self, request: Request, template: str, status: int = 200, **context: Any) -> Response:
        return html_page(template, status, person=request.state.person, may_leave=self.may_leave, **context)


def _word(form: FormData, name: str) -> str:
    value = form.get(name)
    return value.strip() if isinstance(value, str) else ""
