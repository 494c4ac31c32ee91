"""Certification dossier of the prognostic model in one home, as one offline file.

The inputs that SAE ARP8476 and FAA AC 43-218 ask for: where the data come from, limits, validation, configuration,
changes and known failures. It compiles evidence and grants no credit: the judgement, the safety assessment
and the maintenance programme are the operator's.
"""

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from hashlib import sha256
from importlib import resources
from pathlib import Path

import duckdb

from hdt_trial.frozen import frozen
from hdt_trial.log import entries
from hdt_trial.log import faults as faults_of_log
from hdt_trial.page import Part, bullets, code, document, heading, section, table, verbatim
from hdt_trial.seal import log_folder
from pipelines.lineage import STAGES
from pipelines.storage.catalog import connect
from pipelines.storage.ledger import Ledger
from pipelines.versions import digest

_PURPOSE = (
    "Advisory: it shows line maintenance which exchanger or compressor of an air-conditioning pack is degrading, why, "
    "and how many flights are likely to remain before the aircraft's own message. No crew procedure, dispatch rule "
    "or inspection interval rests on it, and none may without the operator's assessment and the authority's approval."
)
_QUESTIONS = {
    "lineage": """
        select operator, count(distinct tail) as aircraft, count(*) as flights, min(departed_on) as first_day,
            max(departed_on) as last_day from flights group by operator order by operator""",
    "rows": """
        select count(*) as files, sum(delivered)::bigint as delivered, sum(loaded)::bigint as loaded,
            sum(quarantined)::bigint as quarantined, sum(duplicate)::bigint as duplicate from deliveries""",
    "quarantine": """
        select reason, scope, count(*) as entries, sum(n_rows)::bigint as n_rows, count(distinct file) as files
        from quarantine group by reason, scope order by entries desc, reason""",
    "gaps": "select gap, count(*) as times, count(distinct tail) as aircraft from data_gaps group by gap order by gap",
    "legs": """
        select coalesce(nullif(reason, ''), 'admitted') as reason, count(*) as legs from legs
        group by all order by legs desc, reason""",
    "status": """
        select component, parameter, status, count(*) as estimates, count(distinct tail) as aircraft
        from health_parameters group by all order by component, parameter, estimates desc""",
    "design": """
        select component, scope, parameter, count(*) as values, count(*) filter (where identifiable) as identifiable
        from design_parameters group by all order by component, scope, parameter""",
    "components": "select component, name, lost, message_code, limit_loss, version from tables.components order by 1",
    "outcomes": """
        select component, diagnosis, outcome, count(*) as alerts from alert_outcomes group by all order by all""",
    "lead": """
        select component, count(*) as events, count(lead_flights) as foretold,
            median(lead_flights) as lead_median_flights, quantile_cont(lead_flights, 0.1) as lead_p10_flights
        from alert_lead_times group by component order by component""",
    "missed": """
        select operator, tail, pack, component, message_time, code from alert_lead_times where lead_flights is null
        order by message_time""",
    "false_alarms": """
        select operator, tail, pack, component, diagnosis, raised_at, closed_at, outcome from false_alarms
        order by raised_at""",
    "models": """
        select component, model_version, split, min(departed_on) as first_day, max(departed_on) as last_day,
            count(*) as prognoses from prognoses group by all order by first_day, component, model_version""",
}  # fmt: skip


def write_dossier(home: Path, attached: Sequence[Path] = ()) -> str:
    """Compile the dossier as HTML.

    Parameters
    ----------
    home : Path
        A home with a catalog.
    attached : sequence of Path
        Texts appended in full: limits, validation reports, a trial's page as text.
    """
    with connect(home) as con:
        tables = {name: _table(con, sql) for name, sql in _QUESTIONS.items()}
        checks = [(name, _rows_of(con, sql)) for name, sql in _checks()]
        cards = con.execute("select card from tables.prognosis_model order by month desc limit 1").fetchall()
        configuration = frozen(con, home)
    return document(
        f"Dossier of a prognostic system, {datetime.now(UTC):%Y-%m-%d}",
        section("Purpose and limits of use", _PURPOSE),
        section("Contents by requirement", _contents()),
        section("1 Data lineage", tables["lineage"], tables["rows"], *_subsection("Stages, in order", _stages())),
        section(
            "2 Data quality",
            *_subsection("Quarantined rows by reason", tables["quarantine"]),
            *_subsection("Gaps", tables["gaps"]),
            *_subsection("Legs admitted to calibration", tables["legs"]),
        ),
        section(
            "3 Limits",
            *_subsection("Components and their failure thresholds", tables["components"]),
            *_subsection("Identifiability of design parameters", tables["design"]),
            *_subsection("Status of estimates", tables["status"]),
        ),
        section(
            "4 Validation",
            *_subsection("Model card (scores on aircraft held out of training)", _card(cards)),
            *_subsection("Alert outcomes", tables["outcomes"]),
            *_subsection("Lead time before the aircraft's message", tables["lead"]),
            *_subsection("Checks of the catalog", table(("check", "failing rows"), checks)),
            *_trial(home),
        ),
        section("5 Configuration", _configuration(configuration)),
        section(
            "6 Changes",
            *_subsection("Nights", _nights(home)),
            *_subsection("Model versions in service", tables["models"]),
        ),
        section(
            "7 Known failures",
            *_subsection("Messages without a prior alert", tables["missed"]),
            *_subsection("Alerts that were wrong", tables["false_alarms"]),
        ),
        *(_attachment(path) for path in (*_own_papers(), *attached)),
    )


def _contents() -> Part:
    rows = (
        ("data sources, their integrity and traceability", "1, 2"),
        ("assumptions, operating limits, what is not observable", "3, attached limits"),
        ("validation against outcomes, false and missed alarms, lead", "4, 7"),
        ("configuration control of software, model and thresholds", "5"),
        ("changes in service and their effect", "6"),
        ("known failures and how they are detected", "2, 7"),
        ("not included: safety assessment, training, procedures, approvals", "the operator's"),
    )
    return table(("requirement", "section"), rows)


def _table(con: duckdb.DuckDBPyConnection, sql: str) -> Part:
    answer = con.sql(sql)
    columns = [c.replace("_", " ") for c in answer.columns]
    rows = answer.fetchall()
    return table(columns, ([_format_value(v) for v in row] for row in rows))


def _format_value(value: object) -> str:
    if isinstance(value, datetime):
        return f"{value.astimezone(UTC):%Y-%m-%d %H:%M}"
    if isinstance(value, float):
        return f"{value:.4g}"
    return "" if value is None else f"{value:,}" if isinstance(value, int) else str(value)


def _subsection(title: str, content: Part) -> tuple[Part, Part]:
    return heading(title), content


def _stages() -> Part:
    rows = (
        (
            s.name,
            ", ".join(s.tables),
            ", ".join(s.parents) or "delivered files or declarations",
            digest(*map(repr, s.tables.values()))[:12],
        )
        for s in STAGES
    )
    return table(("stage", "tables", "made from", "code"), rows)


def _checks() -> list[tuple[str, str]]:
    folder = resources.files("sql") / "checks"
    files = sorted((f for f in folder.iterdir() if f.name.endswith(".sql")), key=lambda f: f.name)
    return [(f.name.removesuffix(".sql").replace("_", " "), f.read_text("utf-8")) for f in files]


def _rows_of(con: duckdb.DuckDBPyConnection, sql: str) -> int:
    return len(con.execute(sql).fetchall())


def _card(cards: list[tuple[str]]) -> Part:
    card = json.loads(cards[0][0]) if cards else {}
    return table(("", ""), ((k, code(json.dumps(v)) if isinstance(v, dict) else v) for k, v in card.items()))


def _configuration(now: dict[str, object]) -> Part:
    rows = []
    for name, value in now.items():
        inner = value if isinstance(value, dict) else {"": value}
        rows += [
            (f"{name} {key}".strip(), _format_value(v) if not isinstance(v, list) else ", ".join(v))
            for key, v in inner.items()
        ]
    return table(("item", "value"), rows)


def _nights(home: Path) -> Part:
    """List the last hundred nights and every failed one."""
    nights = Ledger(home, read_only=True).nights().rows()
    rows = [row for k, row in enumerate(nights) if k >= len(nights) - 100 or row[-1] not in ("{}", "")]
    return table(("began", "ended", "files", "new files", "runs", "cells", "failed"), rows)


def _trial(home: Path) -> tuple[Part, ...]:
    """Summarise the sealed log of a shadow trial, if there is one."""
    log = entries(log_folder(home))
    if not log:
        return _subsection("Shadow trial", "No trial on record.")
    faults = list(faults_of_log(log_folder(home)))
    summary = f"{len(log)} entries since {log[0].sealed_at:%Y-%m-%d}; last digest {log[-1].digest}."
    changes = [f"{e.sealed_at:%Y-%m-%d}: {line}" for e in log for line in e.body.get("changes", [])]
    return heading("Shadow trial"), summary, bullets(faults or changes or ["no change since it began"])


def _own_papers() -> list[Path]:
    """Return the project's limits and change log; a wheel lacks the latter, which must then be attached."""
    pages = Path(str(resources.files("pipelines") / "docs")).resolve()  # in a checkout a link to the folder docs
    return [path for path in (pages / "limits.md", pages.parent / "CHANGELOG.md") if path.is_file()]


def _attachment(path: Path) -> Part:
    text = path.read_text("utf-8")
    return section(f"Attached: {path.name}", f"SHA-256 {sha256(path.read_bytes()).hexdigest()}.", verbatim(text))
