"""Select the rows that one operator gets of airframes that others have flown too.

An operator gets its own flights, and the present one also the state at the handover: the airframe's design, units,
alerts and cases, and the loss of its last flight before.
"""

from collections.abc import Sequence

from pipelines.storage.catalog import quote
from pipelines.storage.naming import Name

FLIGHT_COLUMNS = ("flight_id", "now_flight_id", "raised_flight_id", "end_flight_id")
"""The first of these that a row has a value in decides whose it is."""
STATE = "twin_health"
"""Table whose last rows before a handover its new operator gets."""


def names_of(operator: str, names: Sequence[Name]) -> list[Name]:
    """Return the names that airframes had with an operator, each airframe's last as its present one.

    The present name of an airframe that the operator still has is kept: two names with one operator are one airframe.
    """
    own = [n for n in names if n.delivered[0] == operator]
    last = {n.present: n.delivered for n in own if n.present[0] != operator}
    return [Name(n.key, last.get(n.present, n.present), n.flight_tail, n.delivered) for n in own]


def select_rows(table: str, columns: Sequence[str], operator: str, names: Sequence[Name]) -> str:
    """Return the SQL that reads an operator's rows of a table of the catalog, named as in `names_of`.

    Parameters
    ----------
    table : str
        One with a column `operator`.
    columns : sequence of str
        All it has.
    operator : str
    names : sequence of Name
        Those of the home.
    """
    own = quote(operator)
    owner = "t.operator"
    source = f"tables.{table} as t"
    if "file" in columns:  # files refused before their operator was known lie in its folder
        owner = f"coalesce(case when contains(t.file, '/') then split_part(t.file, '/', 1) end, {owner})"
    if (flight := _flight(columns)) and "tail" in columns:
        source += (
            " left join tables.names as n on t.operator = n.present_operator and t.tail = n.present_tail"
            f" and {flight}[:-13] = n.flight_tail"
        )
        owner = f"coalesce(n.operator, {owner})"
    condition = f"where {owner} = {own}"
    if table == STATE:
        before = f"max(t.departed_at) filter ({owner} <> {own}) over (partition by t.operator, t.tail)"
        condition = f"qualify {owner} = {own} or (t.operator = {own} and t.departed_at = {before})"
    return f"select t.*{_renamed(columns, operator, names)} from {source} {condition}"


def _flight(columns: Sequence[str]) -> str:
    """Return the SQL of the flight that decides whose a row is; empty where a table has none."""
    flights = [f"t.{c}" for c in FLIGHT_COLUMNS if c in columns]
    if flights:
        return f"coalesce({', '.join(flights)})"
    return _LAST_OF_CASE if "case_id" in columns else ""


_LAST_OF_CASE = """(
    select max_by(coalesce(a.now_flight_id, a.raised_flight_id), c.line)
    from tables.raw_cases as c join tables.features_alerts as a using (alert_id) where c.case_id = t.case_id)"""


def _renamed(columns: Sequence[str], operator: str, names: Sequence[Name]) -> str:
    """Return the clause that gives airframes which another operator has now the names they had with this one."""
    name_here = {n.key: n.present for n in names_of(operator, names)}
    renamed = {n.present: name_here[n.key] for n in names if name_here.get(n.key, n.present) != n.present}
    pairs = [p for p in (("operator", "tail"), ("airframe_operator", "airframe_tail")) if set(p) <= set(columns)]
    if not renamed or not pairs:
        return ""
    values = []
    for pair in pairs:
        for place, column in enumerate(pair):
            cases = "".join(
                f" when t.{pair[0]} = {quote(old[0])} and t.{pair[1]} = {quote(old[1])} then {quote(new[place])}"
                for old, new in renamed.items()
            )
            values.append(f"case{cases} else t.{column} end as {column}")
    return f" replace ({', '.join(values)})"
