"""Shadow trials whose truth is known: lives, alerts and prognoses drawn from stated laws, sealed night by night.

Not flights through the chain but what the chain would say: lives are Weibull, a prognosis knows the law and the unit's
age (and may be too sure of itself), false alarms come in clusters, and a share of the events is foretold.
"""

import datetime as dt
from dataclasses import dataclass, field

import numpy as np
import polars as pl

from hdt_trial.declaration import DEFAULT, Declaration, read_declaration
from hdt_trial.log import LogEntry
from hdt_trial.outcomes import COLUMNS, Outcomes, outcomes_of

START = dt.datetime(2025, 1, 1, tzinfo=dt.UTC)
A_DAY = 3
SEALED = 300
FOLLOWED = 480
BEFORE = 1200
SHAPE = 3.0
SCALE = 110.0
FORETOLD = 0.8
FALSE_PER_FLIGHT = 0.002
LEVELS = (0.08, 0.5, 0.9)
"""Where 0.05, 0.5 and 0.95 are claimed: a prognosis too sure of itself."""


@dataclass
class Unit:
    """One place: installations and events by flight, alerts by flight with the event they foretell."""

    tail: str
    pack: int
    wears: bool
    installed: list[int] = field(default_factory=list)
    events: list[int] = field(default_factory=list)
    alerts: list[tuple[int, int | None]] = field(default_factory=list)


def departure(flight: int) -> dt.datetime:
    return START + dt.timedelta(days=flight // A_DAY, hours=6 + 3 * (flight % A_DAY))


def fleet(seed: int, tails: int) -> list[Unit]:
    """Flights -BEFORE to FOLLOWED of each aircraft; the trial begins after flight -1 and seals up to SEALED - 1."""
    rng = np.random.default_rng(seed)
    units = []
    for k in range(tails):
        false_rate = FALSE_PER_FLIGHT * rng.gamma(1.0)
        for pack in (1, 2):
            unit = Unit(f"T-{k:03}", pack, wears=rng.random() < 0.4)
            (_wear if unit.wears else _cry)(unit, rng, false_rate)
            units.append(unit)
    return units


def _wear(unit: Unit, rng: np.random.Generator, _: float) -> None:
    at = -BEFORE
    while at < FOLLOWED:
        unit.installed.append(at)
        ends = at + max(1, int(np.ceil(SCALE * rng.weibull(SHAPE))))
        unit.events.append(ends)
        if rng.random() < FORETOLD:
            unit.alerts.append((max(at + 1, ends - int(rng.integers(3, 70))), ends))
        at = ends


def _cry(unit: Unit, rng: np.random.Generator, rate: float) -> None:
    unit.installed.append(-BEFORE)
    alarms = np.flatnonzero(rng.random(FOLLOWED + BEFORE) < rate) - BEFORE
    unit.alerts += [(int(k), None) for k in alarms]


def sealed_by(flight: int) -> int:
    """Last flight of the day."""
    return flight // A_DAY * A_DAY + A_DAY - 1


def lead(alert: int, event: int) -> int:
    return event - sealed_by(alert)


def rul_interval(age: int) -> list[float]:
    """Points of what is left of a life of this age."""
    points = (SCALE * ((age / SCALE) ** SHAPE - np.log1p(-p)) ** (1.0 / SHAPE) - age for p in LEVELS)
    return [min(300.0, float(x)) for x in points]


def chance_50(age: int) -> float:
    return float(-np.expm1((age / SCALE) ** SHAPE - ((age + 50) / SCALE) ** SHAPE))


def declaration() -> Declaration:
    return read_declaration(DEFAULT)


def log(units: list[Unit], every: int = 6) -> list[LogEntry]:
    """The start and a seal each night, as `seal.py` would write them; prognoses each `every` nights, for speed."""
    tails = sorted({u.tail for u in units})
    seals = range(-1, SEALED, A_DAY)
    entries = []
    sealed = set()
    for n, last in enumerate(seals):
        rows = []
        prognoses = []
        for u in units:
            key = {"operator": "AAA", "tail": u.tail, "pack": u.pack, "component": "HX"}
            for at, event in u.alerts:
                name = f"{u.tail}{u.pack}{at}"
                ended = event is not None and event <= last
                if at <= last and name not in sealed and not (n == 0 and ended):
                    sealed.add(name)
                    closed = departure(event).isoformat() if ended else None
                    times = {"raised_at": departure(at).isoformat(), "closed_at": closed}
                    rows.append(key | {"alert_id": name} | times)
            if n % every:
                continue
            age = last - max(i for i in u.installed if i <= last)
            low, middle, high = rul_interval(age) if u.wears else (300.0, 300.0, 300.0)
            outlook = {"rul_low": low, "rul_flights": middle, "rul_high": high, "model_version": "m"}
            chance = chance_50(age) if u.wears else 0.0
            prognoses.append(key | outlook | {"departed_at": departure(last).isoformat(), "p_event_50": chance})
        flown = [{"operator": "AAA", "tail": t, "until": departure(last).isoformat()} for t in tails]
        body = {"flown": flown, "alerts": {"hdt": rows}, "withdrawn": {}, "prognoses": prognoses}
        if n == 0:
            body |= {"declaration": DEFAULT, "frozen": {"version": "0"}}
        at = departure(last) + dt.timedelta(hours=5)
        entries.append(LogEntry(n, "night" if n else "start", at, "", body, f"{n}"))
    return entries


def outcomes(units: list[Unit], declared: Declaration) -> Outcomes:
    rows = []
    for u in units:
        for event in (e for e in u.events if -BEFORE < e < FOLLOWED):
            at = departure(event)
            place = ("AAA", u.tail, u.pack, "HX")
            rows += [(*place, at + dt.timedelta(hours=1), "MESSAGE", None)]
            rows += [(*place, at + dt.timedelta(hours=2), "REPLACED", "FOULED")]
    departed = [departure(k) for k in range(-BEFORE, FOLLOWED)]
    frame = pl.DataFrame(rows, schema=list(COLUMNS[:7]), orient="row").sort("at")
    return outcomes_of(frame, {("AAA", u.tail): departed for u in units}, declared)


def truth(units: list[Unit], declared: Declaration) -> dict[str, float]:
    """The page's figures by the generator's own account: every life whole, nothing sealed, nothing cut."""
    cost = declared.cost
    flown = FOLLOWED * len(units) / 2
    hits = 0
    leads = []
    events = 0
    false = 0
    within = []
    low = []
    soon = []
    for u in units:
        by_event = {event: at for at, event in u.alerts if event is not None}
        for event in (e for e in u.events if 0 <= e < FOLLOWED):
            lead_flights = lead(by_event[event], event) if event in by_event else 0
            events += 1
            leads += [lead_flights] if lead_flights > 0 else []
            hits += declared.late_flights <= lead_flights <= declared.early_flights
        false += sum(at >= 0 for at, event in u.alerts if event is None)
        for k in range(A_DAY - 1, FOLLOWED, A_DAY):
            if not u.wears:
                soon.append(False)
                continue
            age = k - max(i for i in u.installed if i <= k)
            life = min(e for e in u.events if e > k) - k
            shortest, _, longest = rul_interval(age)
            within.append(shortest <= life <= longest)
            low.append(life < shortest)
            soon.append(life <= 50)
    new = [event and lead(at, event) for u in units for at, event in u.alerts if 0 <= at < SEALED]
    counted_leads = (lead_flights or 0 for lead_flights in new if lead_flights is None or lead_flights > 0)
    right = [declared.late_flights <= lead_flights <= declared.early_flights for lead_flights in counted_leads]
    return {
        "false_alarms": 1000.0 * false / flown,
        "foretold": hits / events,
        "foretold_at_all": len(leads) / events,
        "lead_median": float(np.median(leads)),
        "lead_p10": float(np.quantile(leads, 0.1)),
        "right": float(np.mean(right)),
        "right_or_answered": float(np.mean(right)),
        "cost_avoided": 1000.0 * hits * (cost.unscheduled_event - cost.scheduled_removal) / flown,
        "cost_caused": 1000.0 * false * cost.false_alarm / flown,
        "coverage": float(np.mean(within)),
        "too_low": float(np.mean(low)),
        "event_50": float(np.mean(soon)),
    }
