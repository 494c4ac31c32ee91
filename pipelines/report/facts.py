"""Read everything the report shows from the catalog."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import polars as pl

from hdt_core.calibration.dsm import Dsm
from pipelines.report.rows import UnitRow, dates_line, read_rows
from pipelines.report.tasks import Tasks, read_tasks
from pipelines.storage.catalog_checks import connect_current
from pipelines.storage.publication import publish_lines
from pipelines.storage.view_headers import views

_SEGMENT = """
    with best as (
        select operator, flight_id, pack from tables.legs_samples
        where monitored and phase = 'cruise' and hx_out_k is not null
        group by operator, flight_id, pack
        having count(*) >= 5
        order by max(n_averaged) > 1 desc, count(*) desc, max(time_utc) desc, pack
        limit 1
    )
    select s.*, t as twin from best
    join tables.legs_samples as s on best.operator = s.operator and best.flight_id = s.flight_id and best.pack = s.pack
    join tables.twin_flights as t on best.operator = t.operator and best.flight_id = t.flight_id and best.pack = t.pack
    order by s.time_utc, s.source"""
"""Samples of the flight and pack with most cruise, continuous logs first, then the latest; `twin` is its estimate."""

_FRAMES = {
    "component_losses": """
        select operator, tail, pack, component, flight_id, departed_at, loss, loss_sd from component_features
        where loss is not null order by departed_at, flight_id""",
    "flights": "select operator, tail, flight_id, departed_at, source from flights order by departed_at, flight_id",
    "health": """
        select operator, tail, pack, flight_id, departed_at, parameter, value, sd from health_parameters
        where
            value is not null and parameter in ('hx_fouling', 'cc_efficiency_loss')
            and departed_at >= (select max(departed_at) from flights) - interval 400 days
        order by departed_at, flight_id""",
    "alerts": """
        select a.*, o.place, b.found_on as opened_on
        from alert_states as a left join open_alerts as o on a.alert_id = o.alert_id
        left join alert_outcomes as b on a.follows = b.alert_id
        order by a.closed_at is not null, o.place, a.raised_at desc, a.alert_id""",
    "cases": "select alert_id, state, owner, muted_until, finding, found_by, found_on from cases",
    "stops": """
        select *, max(expected_cost) filter (choice = 'defer')
            over (partition by operator, tail, pack, component) as defer_cost
        from next_stop order by place nulls last, choice""",
    "due": "select * from due_dates",
    "references": "select * from reference_classes",
    "hit_rates": "select * from alert_hit_rates order by component, diagnosis",
    "maintenance": "select * from tables.raw_maintenance order by done_on, reference",
    "messages": "select * from tables.raw_messages order by message_time, code",
    "design": "select * from design_parameters order by scope, component, parameter, operator, tail, pack",
    "filter_yield": "select * from filter_yield order by operator, tail, month",
    "reasons": "select reason, count(*) as legs from legs where not admitted group by reason order by 2 desc, 1",
    "gaps": "select * from data_gaps order by until_at desc, operator, tail, gap",
    "unlogged": "select * from unlogged_work order by departed_at desc, operator, tail, pack, component",
    "quarantine": """
        select reason, scope, count(*) as entries, sum(n_rows)::bigint as n_rows, count(distinct file) as files,
            min(file) as example_file, arg_min(row, file) as example_row, arg_min(detail, file) as example
        from quarantine group by reason, scope order by n_rows desc, reason, scope""",
    "deliveries": """
        select count(*) as files, coalesce(sum(delivered), 0)::bigint as delivered,
            coalesce(sum(loaded), 0)::bigint as loaded, coalesce(sum(quarantined), 0)::bigint as quarantined,
            coalesce(sum(duplicate), 0)::bigint as duplicate
        from deliveries""",
    "twin": """
        select t.operator, t.tail, t.pack, t.flight_id, t.departed_at, l.admitted, t.ua_w_k, t.ua_expected_w_k,
            t.diameter_m, t.group_m3, t.vda_counts
        from tables.twin_flights as t
        join legs as l on t.operator = l.operator and t.flight_id = l.flight_id and t.pack = l.pack
        order by t.departed_at, t.flight_id, t.pack""",
    "segment": _SEGMENT,
}
_OF_NO_UNIT = {"design", "filter_yield", "reasons", "unlogged", "quarantine", "deliveries", "twin", "segment"}
"""Frames that the tables and cards of units do not show."""


@dataclass(frozen=True, slots=True)
class Facts:
    """Frames of the catalog by subject.

    `dates` is the line of `rows.dates_line`; `rows` are the units', the most urgent first. Of the figures' frames
    `twin` has a row a flight and pack, `segment` the samples of one flight and pack and `twin_flight` its estimate.
    `card` is the model card, `dsm` the model in service, None before the first; `tasks` is the work of each action.
    """

    dates: str
    rows: list[UnitRow]
    frames: dict[str, pl.DataFrame]
    card: dict[str, Any]
    dsm: Dsm | None
    tasks: Tasks

    def __getitem__(self, name: str) -> pl.DataFrame:
        return self.frames[name]

    def until(self) -> Any:
        """Return the departure of the last flight; None where there is none."""
        return self.frames["flights"]["departed_at"].max()

    def of_pack(self, name: str, operator: str, tail: str, pack: int) -> pl.DataFrame:
        """Return the rows of one pack."""
        return self.frames[name].filter(operator=operator, tail=tail, pack=pack)


def read_facts(home: Path, *, units_only: bool = False) -> Facts:
    """Read the facts of a home, all or those of its units."""
    publish_lines(home)
    tasks = read_tasks(home)
    with connect_current(home) as con:
        names = [name for name in _FRAMES if not (units_only and name in _OF_NO_UNIT)]
        frames = {name: con.sql(_FRAMES[name]).pl() for name in names}
        if not units_only:
            frames["twin_flight"] = frames["segment"].select("twin").head(1).unnest("twin")
            frames["segment"] = frames["segment"].drop("twin")
        cards = con.execute("select card from tables.prognosis_model order by month desc limit 1").fetchall()
        models = con.execute("select model from tables.calibration_dsm limit 1").fetchall()
        card = json.loads(cards[0][0]) if cards else {}
        return Facts(dates_line(con), read_rows(con, tasks), frames, card, _dsm(models), tasks)


def views_read() -> list[str]:
    """List the views that the page reads."""
    queries = " ".join(["unit_rows", *_FRAMES.values()])
    return [view for view in views() if re.search(rf"\b{view}\b", queries)]


def _dsm(models: list[tuple[str]]) -> Dsm | None:
    """Return the model in service; None before the first, and for one of an older version."""
    try:
        return Dsm.from_dict(json.loads(models[0][0])) if models else None
    except (KeyError, TypeError):
        return None
