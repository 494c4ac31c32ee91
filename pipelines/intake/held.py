"""Describe the flights that are held, for the terminal, the digest and `hdt doctor`."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

from hdt_core.record import two_aircraft, two_operators
from pipelines.intake.faults import REASONS, limit_lines
from pipelines.words import _, several

if TYPE_CHECKING:
    import duckdb

HELD_GROUPS = """
select operator, tail, reason, likely_cause, count(*) as n,
    min_by(flight_id, departed_at) as flight_id, min_by(other_flight_id, departed_at) as other_flight_id
from held_flights group by all order by n desc, operator, tail, reason, likely_cause
"""
HELD_FLIGHTS = """
select operator, tail, reason, likely_cause, 1 as n, flight_id, other_flight_id
from held_flights order by all
"""


def held_flights(con: "duckdb.DuckDBPyConnection", query: str = HELD_FLIGHTS) -> list[dict[str, Any]]:
    """Query held flights one by one, or by aircraft, reason and cause."""
    return list(con.sql(query).pl().iter_rows(named=True))


def held_lines(groups: Iterable[Mapping[str, Any]]) -> list[str]:
    """Report each group of held flights in a line."""
    lines = [f"{g['operator']} {g['tail']}: {describe_held(g)}" for g in groups]
    return limit_lines(lines, "hdt query 'from held_flights'")


def describe_held(group: Mapping[str, Any]) -> str:
    """Describe held flights of one aircraft: which, why and what made them so."""
    flights = several("{n} flight", "{n} flights", group["n"])
    first = _("{flights} from {first} on", flights=flights, first=group["flight_id"])
    name = first if group["n"] > 1 else group["flight_id"]
    cause = _("Likely cause: {cause}.", cause=_cause_of(group)) if group["likely_cause"] else ""
    return f"{name}. {REASONS[group['reason']].sentence} {cause}".rstrip()


def _cause_of(group: Mapping[str, Any]) -> str:
    """Name the likely cause of held flights, with both aircraft where two were exchanged."""
    cause = group["likely_cause"]
    if not cause.startswith(two_aircraft.CAUSE):
        return cause_in_words(cause)
    return _(
        "recorders of {tail} and {other} exchanged; in {other}'s record they follow {before}",
        tail=group["tail"],
        other=cause.removeprefix(two_aircraft.CAUSE),
        before=group["other_flight_id"],
    )


_NEW_FLIGHTS = """
select count(distinct d.operator || d.flight_id) as n,
    count(distinct d.operator || d.flight_id) filter (h.reason = 'after_clock') as n_after
from tables.raw_deliveries as d
left join held_flights as h on d.operator = h.operator and d.flight_id = h.flight_id
where d.loaded > 0 and list_contains($files, d.file)
"""


def clock_fault(con: "duckdb.DuckDBPyConnection", new_files: Iterable[str]) -> str:
    """Describe the machine's clock where most of the flights in new files lie after it; empty otherwise."""
    ((n, n_after),) = con.execute(_NEW_FLIGHTS, {"files": sorted(new_files)}).fetchall()
    if 2 * n_after <= n:
        return ""
    return _("this machine's clock is wrong: {late} of {n} new flights lie after it and wait", late=n_after, n=n)


def cause_in_words(cause: str) -> str:
    """Name a likely cause."""
    if cause.startswith(two_operators.CAUSE):
        return _("{operator} delivered the flights too", operator=cause.removeprefix(two_operators.CAUSE))
    return {
        "week_rollover": _("the week number of GPS began anew, 1,024 weeks"),
        "year": _("another year"),
        "month": _("another month"),
        "day_month_exchanged": _("day and month exchanged"),
        "default_date": _("a clock that was never set"),
        "midnight": _("the date was not advanced at midnight"),
        "hours": _("a clock some hours off"),
        "log_clock": _("the log's clock is not that of the reports"),
        "kg_per_minute": _("the flow is in kg/min"),
        "log_packs": _("one of the two has the packs in each other's place"),
    }.get(cause, cause)
