"""Serve the page of cases: a signed-in person reads, and an engineer changes, the cases of their operators.

The page reads the catalog and the log of cases and writes only lines of that log. No script runs in it.
"""

import re
import sqlite3
import threading
from collections.abc import Callable, Collection
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import duckdb
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from pipelines.casework import (
    ACTIONS,
    KINDS,
    NAMED,
    OPEN,
    RefusedError,
    change_case,
    findings,
    history_of,
    list_cases,
    why_withdrawn,
    withdrawn_cases,
)
from pipelines.digest.changes import Digest, changes_since
from pipelines.digest.render import lines
from pipelines.report import words
from pipelines.report.facts import read_facts
from pipelines.report.tonight import tonight_with_cards
from pipelines.storage.cases import ConflictError
from pipelines.storage.catalog import catalog_version
from pipelines.storage.database import DatabaseError
from pipelines.storage.settings import alert_limits
from pipelines.web.guard import Guard
from pipelines.web.html import html_page
from pipelines.web.sign_in import LocalToken, SignIn

MAX_BODY = 64 << 10
_FIELDS = ("note", "assignee", "until", "finding", "action", "on", "reference")
_READING = threading.Lock()
Row = dict[str, Any]
Result = TypeVar("Result")
_UNREADABLE = (OSError, DatabaseError, duckdb.Error, sqlite3.Error)


def application(home: Path, names: Collection[str], sign_in: SignIn) -> Guard:
    """Build the page of a home, reachable by the host `names` after `sign_in`."""
    casebook = Casebook(home, with_logout=isinstance(sign_in, LocalToken))
    routes = [
        Route("/", casebook.list, methods=["GET"]),
        Route("/unit/{card:str}", casebook.unit, methods=["GET"]),
        Route("/case/{name:str}", casebook.show, methods=["GET"]),
        Route("/case/{name:str}", casebook.change, methods=["POST"]),
    ]
    app = Starlette(routes=routes, exception_handlers=dict.fromkeys(_UNREADABLE, casebook.unreadable))
    return Guard(app, names, sign_in, MAX_BODY)


@lru_cache(maxsize=1)
def _shift_of(home: Path, _version: tuple[int, int]) -> tuple[dict[str, Any], Digest]:
    facts = read_facts(home, units_only=True)
    return tonight_with_cards(facts, alert_limits(home).fouling) | {"dates": facts.dates}, changes_since(home)


def _read_shift(home: Path) -> tuple[dict[str, Any], Digest]:
    """Read table and cards of the report, and the changes since the night before, once a night."""
    return _shift_of(home, catalog_version(home))


async def _read(query: Callable[..., Result], *values: Any, **named: Any) -> Result:
    """Run a query of the catalog in a thread, one at a time.

    While a connection is open DuckDB opens the same file for others of the process, also where a night replaced it.
    """

    def run() -> Result:
        with _READING:
            return query(*values, **named)

    return await run_in_threadpool(run)


def _links(rows: list[Row], cases: list[Row]) -> dict[tuple[Any, ...], str]:
    """Return the page of each unit's first open case; a pack's are those of no unit with a row of its own."""
    units = {r["unit"] for r in rows}
    links: dict[tuple[Any, ...], str] = {}
    for case in (c for c in cases if c["closed_at"] is None):
        unit = (*words.unit_key(case), case["component"])
        links.setdefault(unit if unit in units else unit[:3], f"/case/{case['case_id']}")
    return links


class Casebook:
    """Routes of one home's page.

    Parameters
    ----------
    home : Path
        Home that the page shows.
    with_logout : bool
        Whether this server holds the session and can end it.
    """

    def __init__(self, home: Path, with_logout: bool) -> None:
        self.home = home
        self.with_logout = with_logout

    async def list(self, request: Request) -> Response:
        """Show what changed, the units in need of attention and the open cases, or all, of the person's operators."""
        person = request.state.person
        every = "all" in request.query_params
        every_case = await _read(list_cases, self.home, "true" if every else OPEN)
        cases = [c for c in every_case if person.may_read(c["operator"])]
        table, digest = await _read(_read_shift, self.home)
        rows = [r for r in table["rows"] if person.may_read(r["operator"])]
        changes = [digest.of(o) for o in person.operators or (None,)] if digest.since else []
        return self._page(
            request, "cases.html", title="Cases", dates=table["dates"], cases=cases, every=every, rows=rows,
            ticks=table["ticks"], links=_links(rows, cases),
            changes=[group for own_changes in changes for group in lines(own_changes)],
        )  # fmt: skip

    async def unit(self, request: Request) -> Response:
        """Show the card of one unit."""
        table, _digest = await _read(_read_shift, self.home)
        own = [c for c in table["cards"] if request.state.person.may_read(c["operator"])]
        card = next((c for c in own if c["card"] == request.path_params["card"]), None)
        if card is None:
            return self._none(request)
        return self._page(request, "unit.html", title=card["name"], card=card, hit_rates=table["hit_rates"])

    async def show(self, request: Request) -> Response:
        """Show one case."""
        return await self._case(request, await self._find(request))

    async def change(self, request: Request) -> Response:
        """Write a line about a case."""
        case = await self._find(request)
        person = request.state.person
        if case is None:
            return await self._withdrawn(request, 409, "Nothing was written.")
        if not person.may_change:
            return self._message(request, 403, "A viewer changes nothing; ask an engineer.")
        async with request.form(max_files=0) as form:
            kind = _field(form, "kind")
            line = _field(form, "seen")
            fields = {k: _field(form, k) or None for k in _FIELDS}
        if kind not in KINDS or not re.fullmatch(r"[0-9]{1,18}", line):
            return self._message(request, 400, "This page has no such action.")
        try:
            message = await run_in_threadpool(
                lambda: change_case(self.home, case, kind, person.name, int(line), **fields)
            )
        except ConflictError as error:
            return await self._case(request, await self._find(request), 409, f"Nothing was written: {error}.")
        except RefusedError as error:
            return await self._case(request, case, 422, f"Nothing was written: {error}.")
        return await self._case(request, await self._find(request), message=message)

    async def unreadable(self, request: Request, error: Exception) -> Response:
        """Report in one line why the catalog can't be read."""
        if isinstance(error, duckdb.CatalogException | duckdb.BinderException):
            return self._message(request, 503, "An earlier version wrote the catalog; the next night renews it.")
        return self._message(request, 503, f"{str(error).splitlines()[0]}.")

    async def _find(self, request: Request) -> Row | None:
        """Return the case of the full id in the address, its own or one of its alert's, if the person may read it."""
        cases = await _read(list_cases, self.home, NAMED, id=request.path_params["name"])
        return next((c for c in cases if request.state.person.may_read(c["operator"])), None)

    async def _case(self, request: Request, case: Row | None, status: int = 200, message: str = "") -> Response:
        if case is None:
            return await self._withdrawn(request, status, message)
        table, _digest = await _read(_read_shift, self.home)
        cards = {c["unit"]: c for c in table["cards"]}
        unit = (*words.unit_key(case), case["component"])
        card = cards.get(unit) or cards.get(unit[:3])
        own = [a for a in card["alerts"] if a["alert_id"] == case["alert_id"]] if card else []
        alerts = [a | {"case": []} for a in own]  # its state stands below as it is now
        context = {
            "title": f"{words.unit_name(case)}: {words.diagnosis(case['diagnosis'])}",
            "card": card and card | {"alerts": alerts},
            "hit_rates": table["hit_rates"],
            "history": await run_in_threadpool(history_of, self.home, case),
            "findings": list(findings(case["component"])),
        }
        return self._page(request, "case.html", status, case=case, message=message, actions=ACTIONS, **context)

    async def _withdrawn(self, request: Request, status: int, message: str) -> Response:
        """Show a case whose alert a night withdrew; a link to it may be on an order or in a message."""
        name = request.path_params["name"]
        person = request.state.person
        cases = await run_in_threadpool(withdrawn_cases, self.home, lambda own: own == name)
        case = next((c for c in cases if person.may_read(c["operator"])), None)
        if case is None:
            return self._none(request)
        history = await run_in_threadpool(history_of, self.home, case)
        title = f"{words.unit_name(case)}: {words.diagnosis(case['diagnosis'])}"
        context = {"title": title, "case": case, "reason": why_withdrawn(case), "history": history}
        return self._page(request, "withdrawn.html", status, message=message, **context)

    def _none(self, request: Request) -> Response:
        """Answer alike for a case that does not exist and for one of another operator."""
        return self._message(request, 404, "There is no such case.")

    def _message(self, request: Request, status: int, message: str) -> Response:
        return self._page(request, "message.html", status, title="Cases", message=message)

    def _page(self, request: Request, template: str, status: int = 200, **context: Any) -> Response:
        return html_page(template, status, person=request.state.person, with_logout=self.with_logout, **context)


def _field(form: FormData, name: str) -> str:
    value = form.get(name)
    return value.strip() if isinstance(value, str) else ""
