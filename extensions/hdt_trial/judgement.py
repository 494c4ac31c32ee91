"""Score each sealed alert, event and prognosis by the declared definitions.

An alert counts from the night that sealed it: from its aircraft's last flight on record then, never from its stated
time of raising. Alerts and prognoses without enough flights since are not scored.
"""

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from hdt_trial.declaration import Declaration
from hdt_trial.log import LogEntry
from hdt_trial.outcomes import Outcomes
from hdt_trial.seal import Place, place_of

Tail = tuple[str, str]

VERDICTS = ("hit", "too_late", "too_early", "answered", "false_alarm", "after_event", "removed", "open")
"""Of an alert: in time; an event too soon; an event too far off; work took away a loss that the flights show; no event
came; it had come; the unit went without a finding; not flown long enough to tell."""


@dataclass(frozen=True, slots=True)
class SealedAlert:
    """An alert as it was first sealed."""

    source: str
    place: Place
    known_at: datetime
    """Departure of the aircraft's last flight that was known when it was sealed."""
    sealed_at: datetime
    closed_at: datetime | None
    standing: bool
    """It stood when the trial began."""


@dataclass(frozen=True, slots=True)
class JudgedAlert:
    """Its verdict."""

    alert: SealedAlert
    verdict: str
    followed: bool
    """The aircraft flew on for `early_flights`: who is judged by then is judged without regard to the outcome."""
    lead_flights: int | None


@dataclass(frozen=True, slots=True)
class JudgedEvent:
    """Whether an event was foretold: hit, too_late, too_early, missed."""

    place: Place
    at: datetime
    verdict: str
    lead_flights: int | None
    standing: bool
    sealed_at: datetime | None
    """Clock time at which the alert that foretold it was sealed."""


@dataclass(frozen=True, slots=True)
class JudgedPrognosis:
    """A prognosis whose interval can be judged, or its chance of an event within 50 flights; None where not."""

    tail: Tail
    within: bool | None
    too_low: bool | None
    p_event_50: float | None
    event_50: bool | None


@dataclass(frozen=True)
class Judge:
    """Score by these definitions and outcomes."""

    declared: Declaration
    outcomes: Outcomes

    def flown(self, tail: Tail, after: datetime, until: datetime | None = None) -> int:
        """Flights of an aircraft that departed after one time and up to another, or up to the last that is known."""
        times = self.outcomes.departed.get(tail, [])
        last = len(times) if until is None else bisect_right(times, until)
        return max(0, last - bisect_right(times, after))

    def alert(self, alert: SealedAlert) -> JudgedAlert:
        """Score an alert."""
        d = self.declared
        place = alert.place
        tail = alert.place[:2]
        followed = self.flown(tail, alert.known_at) >= d.early_flights
        removed = _next(self.outcomes.removals, place, alert.known_at)
        if self.event_of_unit(place, alert.known_at) is not None:
            return JudgedAlert(alert, "after_event", followed, None)
        event = _next(self.outcomes.events, place, alert.known_at)
        if event and (removed is None or event <= removed) and not self.lapsed(alert, event):
            lead = self.flown(tail, alert.known_at, event)
            if not lead:  # it came on the last flight that was known: the outcome could have been, too
                return JudgedAlert(alert, "after_event", followed, None)
            return JudgedAlert(alert, self.in_time(lead), followed, lead)
        cleared = _next(self.outcomes.no_faults, place, alert.known_at)
        if cleared and (removed is None or cleared <= removed):
            return JudgedAlert(alert, "false_alarm", followed, None)
        answered = _next(self.outcomes.answers, place, alert.known_at)
        for verdict, at in (("answered", answered), ("removed", removed)):
            if at and self.flown(tail, alert.known_at, at) < d.early_flights:
                return JudgedAlert(alert, verdict, followed, None)
        return JudgedAlert(alert, "false_alarm" if followed else "open", followed, None)

    def event(self, place: Place, at: datetime, alerts: Sequence[SealedAlert]) -> JudgedEvent:
        """Score an event by the first alert of its unit sealed before it."""
        begun = _last(self.outcomes.removals, place, at)
        before = [
            a for a in alerts if a.known_at < at and (begun is None or a.known_at >= begun) and not self.lapsed(a, at)
        ]
        leads = [(lead, a) for a in before if (lead := self.flown(place[:2], a.known_at, at))]
        timely = [(lead, a) for lead, a in leads if lead <= self.declared.early_flights]
        if not leads:
            return JudgedEvent(place, at, "missed", None, False, None)
        lead, first = max(timely or leads, key=lambda pair: pair[0])
        return JudgedEvent(place, at, self.in_time(lead), lead, first.standing, first.sealed_at)

    def in_time(self, lead_flights: int) -> str:
        """Whether an alert came in time."""
        if lead_flights < self.declared.late_flights:
            return "too_late"
        return "too_early" if lead_flights > self.declared.early_flights else "hit"

    def lapsed(self, alert: SealedAlert, event: datetime) -> bool:
        """Whether an alert had closed long before the event."""
        return alert.closed_at is not None and alert.closed_at < event - timedelta(days=self.declared.lapse_days)

    def event_of_unit(self, place: Place, at: datetime) -> datetime | None:
        """The event that the unit fitted at `at` had had by then."""
        begun, event = (_last(when, place, at) for when in (self.outcomes.removals, self.outcomes.events))
        return event if event and (begun is None or event > begun) else None

    def prognosis(self, row: dict[str, Any]) -> JudgedPrognosis | None:
        """Score a prognosis; None where its outcome is not known yet."""
        place = place_of(row)
        departed_at = datetime.fromisoformat(row["departed_at"])
        if row["rul_low"] is None or self.event_of_unit(place, departed_at):
            return None
        removed = _next(self.outcomes.removals, place, departed_at)
        event = _next(self.outcomes.events, place, departed_at)
        life = self.flown(place[:2], departed_at, event) if event and (removed is None or event <= removed) else None
        flights_since = self.flown(place[:2], departed_at)
        alive = flights_since if life is not None or removed is None else self.flown(place[:2], departed_at, removed)
        horizon = self.declared.horizon_flights
        low, high = (min(row[c], horizon) for c in ("rul_low", "rul_high"))

        def followed_for(
            flights: float,
        ) -> bool:  # whoever is judged is chosen by how long it was followed, not by the outcome
            return flights_since >= flights and (life is not None or alive >= flights)

        within = life is not None and low <= life <= high
        return JudgedPrognosis(
            place[:2],
            within if high < horizon and followed_for(high) else None,  # an end at the horizon says "so many or more"
            life is not None and life < low if low < horizon and followed_for(low) else None,
            row["p_event_50"],
            life is not None and life <= 50 if followed_for(50) and row["p_event_50"] is not None else None,
        )


def sealed_alerts(log: Sequence[LogEntry], components: Sequence[str]) -> list[SealedAlert]:
    """Return every alert as first sealed, with its last sealed closing time."""
    first: dict[tuple[str, str], tuple[dict[str, Any], LogEntry, datetime]] = {}
    closed: dict[tuple[str, str], str | None] = {}
    for entry in log:
        flown = {(f["operator"], f["tail"]): f["until"] for f in entry.body.get("flown", [])}
        for source, rows in entry.body.get("alerts", {}).items():
            for row in (r for r in rows if r["component"] in components):
                name = (source, row["alert_id"])
                at = flown.get((row["operator"], row["tail"]), row["raised_at"])
                first.setdefault(name, (row, entry, datetime.fromisoformat(at)))
                closed[name] = row["closed_at"]
    return [
        SealedAlert(name[0], place_of(row), known_at, entry.sealed_at, _time(closed[name]), entry.kind == "start")
        for name, (row, entry, known_at) in first.items()
        # what had closed before the trial began says nothing about it
        if not (entry.kind == "start" and row["closed_at"])
    ]


def sealed_span(log: Sequence[LogEntry]) -> dict[Tail, tuple[datetime, datetime]]:
    """First and last departure that was known of each aircraft while nights were sealed."""
    span: dict[Tail, tuple[datetime, datetime]] = {}
    for entry in log:
        for f in entry.body.get("flown", []):
            tail = (f["operator"], f["tail"])
            until = datetime.fromisoformat(f["until"])
            span[tail] = (span.get(tail, (until, until))[0], until)
    return span


def events_in(span: dict[Tail, tuple[datetime, datetime]], judge: Judge) -> Iterator[tuple[Place, datetime]]:
    """Events that the trial could have foretold in time: `late_flights` after its start, and before its last seal."""
    for place, times in judge.outcomes.events.items():
        if place[:2] not in span or place[3] not in judge.declared.components:
            continue
        first, last = span[place[:2]]
        for at in times:
            sealed = at > first and not judge.flown(place[:2], last, at)
            if sealed and judge.flown(place[:2], first, at) >= judge.declared.late_flights:
                yield place, at


def _next(times: dict[Place, list[datetime]], place: Place, after: datetime) -> datetime | None:
    of_place = times.get(place, [])
    k = bisect_right(of_place, after)
    return of_place[k] if k < len(of_place) else None


def _last(times: dict[Place, list[datetime]], place: Place, before: datetime) -> datetime | None:
    """The last one before a time."""
    of_place = [t for t in times.get(place, []) if t < before]
    return of_place[-1] if of_place else None


def _time(text: str | None) -> datetime | None:
    return datetime.fromisoformat(text) if text else None
