"""The trial's figures with intervals and sample sizes; figures on too few samples are suppressed."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hdt_trial import intervals
from hdt_trial.intervals import Interval
from hdt_trial.judgement import (
    VERDICTS,
    Judge,
    JudgedAlert,
    JudgedEvent,
    JudgedPrognosis,
    SealedAlert,
    Tail,
    events_in,
    sealed_alerts,
    sealed_span,
)
from hdt_trial.log import LogEntry
from hdt_trial.seal import OURS, place_of


@dataclass(frozen=True, slots=True)
class Figure:
    """One number of the page."""

    name: str
    label: str
    unit: str
    interval: Interval | None
    """None where it is suppressed or cannot be computed."""
    n: int | None
    of: str
    """What `n` counts."""
    why_not: str = ""


@dataclass(frozen=True)
class ScoredAlerts:
    """Scored alerts and events of one source, with their exposure."""

    alerts: list[JudgedAlert]
    events: list[JudgedEvent]
    followed: dict[Tail, int]
    """Flights of each aircraft that were sealed and followed for long enough to call an alert false."""
    sealed: dict[Tail, int]
    """Flights of each aircraft while nights were sealed."""
    predictable: dict[Tail, int]
    """Those of them whose events could have been foretold in time."""

    @property
    def verdicts(self) -> Counter[str]:
        """Alerts by verdict."""
        return Counter(dict.fromkeys(VERDICTS, 0) | Counter(a.verdict for a in self.alerts))


def judge_alerts(
    log: Sequence[LogEntry], judge: Judge, source: str = OURS, unsealed: Sequence[SealedAlert] | None = None
) -> ScoredAlerts:
    """Score the alerts of one source and the events they should have foretold.

    Parameters
    ----------
    log : sequence of LogEntry
        Every entry.
    judge : Judge
        Definitions and outcomes.
    source : str
        Whose alerts.
    believed : sequence of SealedAlert, optional
        Alerts that were not sealed; else those that the log holds.
    """
    span = sealed_span(log)
    parts = judge.declared.components
    candidates = sealed_alerts(log, parts) if unsealed is None else [a for a in unsealed if a.place[3] in parts]
    alerts = [a for a in candidates if a.source == source and a.place[:2] in span]
    by_place = defaultdict(list)
    for alert in alerts:
        by_place[alert.place].append(alert)
    events = [judge.event(place, at, by_place[place]) for place, at in events_in(span, judge)]
    sealed = {tail: judge.flown(tail, first, last) for tail, (first, last) in span.items()}
    late = judge.declared.early_flights
    followed = {tail: max(0, min(sealed[tail], judge.flown(tail, first) - late)) for tail, (first, _) in span.items()}
    predictable = {tail: max(0, n - judge.declared.late_flights + 1) for tail, n in sealed.items()}
    return ScoredAlerts([judge.alert(a) for a in alerts], events, followed, sealed, predictable)


def judge_prognoses(log: Sequence[LogEntry], judge: Judge) -> list[JudgedPrognosis]:
    """Score every sealed prognosis of a declared component whose outcome is known."""
    rows = (
        row for entry in log for row in entry.body.get("prognoses", []) if row["component"] in judge.declared.components
    )
    prognoses = (judge.prognosis(row) for row in rows if judge.outcomes.departed.get(place_of(row)[:2]))
    return [t for t in prognoses if t is not None]


@dataclass(frozen=True)
class FigureBuilder:
    """Compute the publishable figures of one source."""

    judge: Judge
    scores: ScoredAlerts

    def alert_figures(self) -> list[Figure]:
        """False alarms, events foretold, lead, alerts that were right, cost."""
        new = [a for a in self.scores.alerts if not a.alert.standing]
        followed = [a for a in new if a.followed and a.verdict not in ("removed", "after_event")]
        events = self.scores.events
        leads = [e for e in self.scores.events if e.lead_flights]
        by_event = [(a.alert.place[:2], a.verdict == "hit") for a in followed]
        by_any = [(a.alert.place[:2], a.verdict in ("hit", "answered")) for a in followed]
        return [
            self._false_alarms(followed),
            self._share(
                "foretold", "Events foretold in time", [(e.place[:2], e.verdict == "hit") for e in events], "events"
            ),
            self._share(
                "foretold_at_all",
                "Events foretold at all",
                [(e.place[:2], e.verdict != "missed") for e in events],
                "events",
            ),
            self._point("lead_median", "Lead, median", leads, 0.5),
            self._point("lead_p10", "Lead, 10th percentile", leads, 0.1),
            self._share("right", "Alerts followed by an event in time", by_event, "alerts"),
            self._share("right_or_answered", "The same, or by work that took a loss away", by_any, "alerts"),
            *self._costs(followed),
        ]

    def prognosis_figures(self, prognoses: Sequence[JudgedPrognosis]) -> list[Figure]:
        """Coverage of the interval, its lower end, and the chance of an event against what came."""

        def of(field: str) -> list[tuple[Tail, bool]]:
            return [(p.tail, bool(v)) for p in prognoses if (v := getattr(p, field)) is not None]

        chances = [p.p_event_50 for p in prognoses if p.event_50 is not None and p.p_event_50 is not None]
        mean = f"; forecast {np.mean(chances):.3f}" if chances else ""
        return [
            self._share("coverage", "Remaining life within its 90 % interval", of("within"), "prognoses"),
            self._share("too_low", "Event before its lower end (nominal 5 %)", of("too_low"), "prognoses"),
            self._share("event_50", f"Event within 50 flights{mean}", of("event_50"), "prognoses"),
        ]  # fmt: skip

    def _false_alarms(self, followed: Sequence[JudgedAlert]) -> Figure:
        wrong = Counter(a.alert.place[:2] for a in followed if a.verdict == "false_alarm")
        exposure = {tail: n for tail, n in self.scores.followed.items() if n}
        flights = sum(exposure.values())
        entry = ("false_alarms", "False alarms", "per 1,000 flights")
        if why := self._too_few(flights, len(exposure)):
            return Figure(*entry, None, None, "flights", why)
        counts = [wrong[tail] for tail in exposure]
        interval = intervals.rate(counts, [n / 1000.0 for n in exposure.values()], self.judge.declared.confidence)
        least = self.judge.declared.minimum.count
        if 0 < sum(counts) < least:
            return Figure(
                *entry,
                None,
                flights,
                "flights",
                f"fewer than {least} false alarms: below {least * 1000.0 / flights:.2f}",
            )
        return Figure(*entry, interval, flights, "flights")

    def _share(self, name: str, label: str, rows: Sequence[tuple[Tail, bool]], of: str) -> Figure:
        tails = {tail for tail, _ in rows}
        least = self.judge.declared.minimum.count
        few = f"fewer than {least} {of}" * (len(rows) < least)
        if why := few or self._too_few(sum(self.scores.sealed.values()), len(tails)):
            return Figure(name, label, "%", None, None, of, why)
        trials = Counter(tail for tail, _ in rows)
        hits = Counter(tail for tail, is_hit in rows if is_hit)
        interval = intervals.share(
            [hits[tail] for tail in trials], list(trials.values()), self.judge.declared.confidence
        )
        return Figure(name, label, "%", interval, len(rows), of)

    def _point(self, name: str, label: str, events: Sequence[JudgedEvent], level: float) -> Figure:
        """Estimate a quantile of the lead; that of an alert open at the start is censored."""
        least = self.judge.declared.minimum.count
        few = f"fewer than {least} events" * (len(events) < least)
        if why := few or self._too_few(sum(self.scores.sealed.values()), len({e.place[:2] for e in events})):
            return Figure(name, label, "flights", None, None, "events", why)
        leads = [float(e.lead_flights or 0) for e in events]
        standing = [e.standing for e in events]
        interval = intervals.point(leads, standing, level, self.judge.declared.confidence)
        why = "" if interval else "most alerts stood when the trial began"
        return Figure(name, label, "flights", interval, len(events), "events", why)

    def _costs(self, followed: Iterable[JudgedAlert]) -> list[Figure]:
        """Sum money by aircraft: saved over sealed flights, spent over those also followed."""
        cost = self.judge.declared.cost
        saved = defaultdict[Tail, float](float)
        spent = defaultdict[Tail, float](float)
        for event in self.scores.events:
            saved[event.place[:2]] += (cost.unscheduled_event - cost.scheduled_removal) * (event.verdict == "hit")
        by = {"false_alarm": cost.false_alarm, "too_early": cost.too_early}
        for alert in followed:
            spent[alert.alert.place[:2]] += by.get(alert.verdict, 0.0)
        return [
            self._cost("cost_avoided", "Cost avoided", saved, self.scores.predictable),
            self._cost("cost_caused", "Cost caused", spent, self.scores.followed),
        ]

    def _cost(self, name: str, label: str, sums: Mapping[Tail, float], over: Mapping[Tail, int]) -> Figure:
        """Money per 1,000 flights, an aircraft a cluster."""
        unit = f"{self.judge.declared.cost.currency} per 1,000 flights"
        least = self.judge.declared.minimum.count
        exposure = {tail: n for tail, n in over.items() if n}
        flights = sum(exposure.values())
        affected = sum(v > 0.0 for v in sums.values())
        few = f"rests on fewer than {least} aircraft" if 0 < affected < least else ""
        if why := self._too_few(flights, len(exposure)) or few:
            return Figure(name, label, unit, None, None, "flights", why)
        thousands = [n / 1000.0 for n in exposure.values()]
        interval = intervals.ratio([sums.get(t, 0.0) for t in exposure], thousands, self.judge.declared.confidence)
        return Figure(name, label, unit, interval, flights, "flights")

    def _too_few(self, flights: int, aircraft: int) -> str:
        least = self.judge.declared.minimum
        if flights < least.flights:
            return f"fewer than {least.flights:,} flights"
        return f"fewer than {least.aircraft} aircraft" if aircraft < least.aircraft else ""


def suppress_small_counts(counts: Mapping[str, int], least: int) -> dict[str, int | None]:
    """Suppress small counts: None stands for one from 1 to `least` - 1.

    Where a single one is kept back the sum would give it away: then the least of the others is kept back as well.

    Examples
    --------
    >>> suppress_small_counts({"hit": 12, "too_late": 2, "open": 7, "removed": 0}, 5)
    {'hit': 12, 'too_late': None, 'open': None, 'removed': 0}
    """
    hidden = {name for name, n in counts.items() if 0 < n < least}
    others = sorted((n, name) for name, n in counts.items() if n >= least)
    if len(hidden) == 1 and others:
        hidden.add(others[0][1])
    return {name: None if name in hidden else n for name, n in counts.items()}
