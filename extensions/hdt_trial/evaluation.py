"""Evaluate a trial: our figures, the operator's rules over the same flights, and suppressed counts."""

import re
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import polars as pl

from hdt_trial.declaration import Declaration, Rule, TrialError
from hdt_trial.figures import Figure, FigureBuilder, ScoredAlerts, judge_alerts, judge_prognoses, suppress_small_counts
from hdt_trial.judgement import Judge, SealedAlert, sealed_span
from hdt_trial.log import LogEntry, entries
from hdt_trial.outcomes import Outcomes, read_outcomes
from hdt_trial.seal import OURS, as_alerts, declaration_of, log_folder, place_of
from pipelines.storage.catalog import connect

_RULE = re.compile(r"^(\[rule\.[^\]\n]*\])\n.*?(?=^\[|\Z)", re.MULTILINE | re.DOTALL)
LATE_SEAL_DAYS = 3.0
"""A night sealed later than this after its last flight is reported: its outcomes may have been known."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """The publishable results."""

    declared: Declaration
    text: str
    """The declaration as it was sealed, without what the operator's rules look at."""
    version: str
    head: str
    nights: int
    began: str
    ended: str
    changes: list[str]
    models: int
    late_nights: int
    after_the_fact: int | None
    """Events foretold whose outcome lay before the clock time of the seal: a rehearsal on old flights."""
    flights: int
    aircraft: int
    prognoses: int
    without_pack: int
    figures: dict[str, list[Figure]]
    """By source: ours and each rule's."""
    verdicts: dict[str, dict[str, int | None]]
    agreement: dict[str, dict[str, int | None]]
    """By rule, events foretold in time by both, by us alone, by the rule alone, by neither."""

    def as_json(self) -> dict[str, Any]:
        """Return the numbers ready for JSON."""
        return asdict(self)


def evaluate(home: Path) -> Evaluation:
    """Evaluate a home's trial against the outcomes on record.

    Raises
    ------
    TrialError
        No trial was started, or a rule's file can't be read.
    """
    log = entries(log_folder(home))
    declared = declaration_of(log)
    with connect(home) as con:
        outcomes = read_outcomes(con, log, declared)
    rules = {rule.name: _alerts_of_file(rule, outcomes, log) for rule in declared.rules if rule.file}
    return evaluate_log(log, declared, outcomes, rules)


def evaluate_log(
    log: Sequence[LogEntry], declared: Declaration, outcomes: Outcomes, unsealed: dict[str, list[SealedAlert]]
) -> Evaluation:
    """Evaluate a log.

    Parameters
    ----------
    log : sequence of LogEntry
        Every entry.
    declared : Declaration
        Its definitions.
    outcomes : Outcomes
        What became of the units.
    believed : dict
        Alerts of rules that were not sealed, as their file has them.
    """
    judge = Judge(declared, outcomes)
    scores = {OURS: judge_alerts(log, judge)}
    scores |= {r.name: judge_alerts(log, judge, r.name, unsealed.get(r.name)) for r in declared.rules}
    prognoses = judge_prognoses(log, judge)
    figures = {source: FigureBuilder(judge, score).alert_figures() for source, score in scores.items()}
    figures[OURS] += FigureBuilder(judge, scores[OURS]).prognosis_figures(prognoses)
    least = declared.minimum.count
    own = scores[OURS]
    foretold = [e for e in own.events if e.verdict in ("hit", "too_late", "too_early") and e.sealed_at]
    after = suppress_small_counts({"n": sum(e.at <= e.sealed_at for e in foretold if e.sealed_at)}, least)["n"]
    return Evaluation(
        declared=declared,
        text=_RULE.sub(r"\1\n# not published\n", log[0].body["declaration"]),
        version=log[0].body["frozen"]["version"],
        head=log[-1].digest,
        nights=sum(e.kind == "night" for e in log),
        began=f"{log[0].sealed_at:%Y-%m}",
        ended=f"{log[-1].sealed_at:%Y-%m}",
        changes=[f"{e.sealed_at:%Y-%m-%d}: {line}" for e in log for line in e.body.get("changes", [])],
        models=len({row["model_version"] for e in log for row in e.body.get("prognoses", [])}),
        late_nights=sum(_sealed_late(e) for e in log),
        after_the_fact=after,
        flights=sum(own.sealed.values()),
        aircraft=len(own.sealed),
        prognoses=sum(len(e.body.get("prognoses", [])) for e in log),
        without_pack=outcomes.without_pack,
        figures=figures,
        verdicts={source: suppress_small_counts(score.verdicts, least) for source, score in scores.items()},
        agreement={r.name: suppress_small_counts(_agreement(own, scores[r.name]), least) for r in declared.rules},
    )


def _agreement(ours: ScoredAlerts, theirs: ScoredAlerts) -> dict[str, int]:
    """Count events by which source foretold them in time; both lists hold the same events in the same order."""
    pairs = [(a.verdict == "hit", b.verdict == "hit") for a, b in zip(ours.events, theirs.events, strict=True)]
    names = {
        (True, True): "both",
        (True, False): "ours alone",
        (False, True): "the rule alone",
        (False, False): "neither",
    }
    return {name: pairs.count(pair) for pair, name in names.items()}


def _alerts_of_file(rule: Rule, outcomes: Outcomes, log: Sequence[LogEntry]) -> list[SealedAlert]:
    """Read a rule's alerts from its file, unsealed: each is dated by the last flight before it was raised."""
    file = Path(str(rule.file))
    span = sealed_span(log)
    try:
        table = pl.read_csv(file, try_parse_dates=True, schema_overrides={"tail": pl.String, "operator": pl.String})
        frame = as_alerts(table, f"{file}")
    except (OSError, pl.exceptions.PolarsError) as error:
        raise TrialError(f"rule {rule.name}: {file} cannot be read: {str(error).splitlines()[0]}") from None
    alerts = []
    for row in frame.iter_rows(named=True):
        place = place_of(row)
        raised_at = row["raised_at"]
        times = outcomes.departed.get(place[:2], [])
        began = span.get(place[:2])
        if began and raised_at <= began[1] and (k := bisect_right(times, raised_at)):
            known_at = times[k - 1]
            standing = raised_at <= began[0]
            alerts.append(SealedAlert(rule.name, place, max(known_at, began[0]), raised_at, row["closed_at"], standing))
    return [a for a in alerts if not (a.closed_at and a.closed_at <= span[a.place[:2]][0])]


def _sealed_late(entry: LogEntry) -> bool:
    last = max((datetime.fromisoformat(f["until"]) for f in entry.body.get("flown", [])), default=None)
    return last is not None and (entry.sealed_at - last).total_seconds() > LATE_SEAL_DAYS * 86400.0
