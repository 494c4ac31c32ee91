"""Read what the home adds to the delivered files: lines of the log of cases, and costs of a stop, part and message.

The costs are those of `costs.toml` over defaults: round figures to be replaced, from no operator's books; the column
`source` distinguishes them.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import polars as pl

from hdt_core.alerts.answers import work_from_cases
from hdt_core.alerts.succession import KINDS_OF_NIGHT
from hdt_core.components import components
from hdt_core.loading import parse_toml, read_text
from hdt_core.tables import TABLES
from pipelines.intake.faults import Fault
from pipelines.versions import digest

CASES, FINDINGS = "cases", "findings"
"""Kinds in the ledger of an aircraft's lines in the log of cases: all of them, and the work in them."""


def case_files(cases: pl.DataFrame) -> list[tuple[str, str, str, str, int, int, str]]:
    """List each aircraft's lines in the log of cases as the ledger lists a delivered file.

    Returns
    -------
    list
        path, operator, tail, kind, number of lines, 0, digest.
    """
    files = []
    by_people = cases.filter(~pl.col("kind").is_in(KINDS_OF_NIGHT))  # the stage that writes the others stores them
    for (o, t), cases_of_aircraft in sorted(by_people.partition_by("operator", "tail", as_dict=True).items()):
        # an acknowledgement must not have the twin computed again: work counts from the first closing on
        closed_cases = cases_of_aircraft.filter((pl.col("kind") == "close").any())
        for kind, rows in ((CASES, cases_of_aircraft), (FINDINGS, work_from_cases(closed_cases))):
            if kind == CASES or closed_cases.height:
                files.append((f"{kind}/{o}/{t}", o, t, kind, rows.height, 0, digest(*map(str, rows.rows()))))
    return files


NAME, COSTS = "costs.toml", "costs"
"""File in the home, and its kind in the ledger."""
ITEMS = ("wash", "replace", "at_check", "message")
"""A wash or a replacement at the next stop; the same work when it waits for a check; what one message costs."""
MAX_COST = 1e12
DEFAULTS: dict[str, Any] = {
    "currency": "USD",
    "horizon_days": 30,
    "HX": {"wash": 3_000, "replace": 30_000, "at_check": 2_000, "message": 40_000},
    "CC": {"replace": 90_000, "at_check": 75_000, "message": 40_000},
}
"""`horizon_days`: planning horizon where no check is planned. [days]"""


class CostError(ValueError):
    """The cost table can't be used; the message names the file, the key and what it must be."""

    def __init__(self, key: str, why: str) -> None:
        super().__init__(f"{NAME}: {key}: {why}" if key else f"{NAME}: {why}")
        self.key = key


def read_costs(home: Path) -> pl.DataFrame:
    """Read the rows of `raw_costs`: the home's file over the defaults.

    Raises
    ------
    CostError
        The file is no TOML, or holds an unknown key or an invalid value.
    """
    declared_costs = dict[str, Any]()
    try:
        declared_costs = parse_toml(read_text(home / NAME))
    except FileNotFoundError:
        pass
    except (ValueError, OSError) as error:
        raise CostError("", f"can't be read: {error}") from None
    own = list(_rows(declared_costs, {}, NAME))  # validated before anything is read from it
    rows = [*own, *_rows(DEFAULTS, declared_costs, "default")]
    general = {k: declared_costs.get(k, DEFAULTS[k]) for k in ("currency", "horizon_days")}
    _check_general(general)
    frame = pl.DataFrame(rows, schema=["component", "item", "cost", "source"], orient="row")
    return TABLES["raw_costs"].schema.conform(
        frame.with_columns(pl.lit(general["currency"]).alias("currency"), horizon_days=pl.lit(general["horizon_days"]))
    )


def _rows(
    costs_of: Mapping[str, Any], override: Mapping[str, Any], source: str
) -> Iterator[tuple[str, str, float, str]]:
    """Yield component, item, cost and source of a table, without the items in `override`."""
    for component, costs in costs_of.items():
        if component in {"currency", "horizon_days"}:
            continue
        if component not in components() or not isinstance(costs, dict):
            raise CostError(component, f"is no table of a component; there are {', '.join(sorted(components()))}")
        for item, cost in costs.items():
            if item not in ITEMS:
                raise CostError(f"{component}.{item}", f"means nothing; there are {', '.join(ITEMS)}")
            if isinstance(cost, bool) or not isinstance(cost, int | float) or not 0 <= cost <= MAX_COST:
                raise CostError(f"{component}.{item}", f"is a number from 0 to {MAX_COST:.0e}, not {cost!r:.40}")
            if item not in override.get(component, {}):
                yield component, item, float(cost), source


def _check_general(general: Mapping[str, Any]) -> None:
    days = general["horizon_days"]
    currency = general["currency"]
    if isinstance(days, bool) or not isinstance(days, int) or not 1 <= days <= 366:
        raise CostError("horizon_days", f"is a whole number of days from 1 to 366, not {days!r:.40}")
    if not isinstance(currency, str) or not 1 <= len(currency) <= 8 or not currency.isprintable():
        raise CostError("currency", f"is a word of up to 8 letters, not {currency!r:.40}")


def costs_or_fault(home: Path) -> tuple[pl.DataFrame, list[Fault]]:
    """Read the cost table; with a fault and no rows where the file is wrong: a night uses no other costs instead."""
    try:
        return read_costs(home), []
    except CostError as error:
        return TABLES["raw_costs"].schema.create_empty(), [Fault("bad_cost", None, error.key or None, f"{error}.")]
