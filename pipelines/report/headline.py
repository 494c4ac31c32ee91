"""What to do tonight, in words."""

from typing import Any

from pipelines.report import words
from pipelines.report.facts import Facts
from pipelines.report.html import Html, anchor, join, tag


def headline(facts: Facts) -> Html:
    """First what can't wait, with its action; then what to plan, what isn't known, and who is silent."""
    rows = facts["ranking"].to_dicts()
    if not rows:
        return join(
            tag("p", _heard(facts), class_="lead"),
            tag("p", "There is no health estimate of a pack yet: no flight with steady cruise has arrived."),
            _components(facts),
        )
    act, plan, unknown = ([r for r in rows if r["urgency"] == u] for u in ("act", "plan", "unknown"))
    return join(
        tag("p", _summary(act, plan, len(rows)), class_="lead"),
        tag("ol", *(_item(facts, r) for r in act)) if act else None,
        join(tag("h3", "To plan"), tag("ul", *(_item(facts, r) for r in plan))) if plan else None,
        _components(facts),
        _not_known(unknown),
        _silent(facts["gaps"].filter(gap="silent_now").to_dicts()),
        tag("p", _heard(facts), class_="small"),
    )


def _components(facts: Facts) -> Html | None:
    """Units of other components that want work."""
    wanted = [r for r in facts["components"].to_dicts() if r["urgency"] in ("act", "plan")]
    if not wanted:
        return None
    said = (
        tag(
            "li",
            tag("b", tag("a", words.unit_name(r), href=f"#{anchor('unit', r['component'], *words.unit_key(r))}")),
            f": {words.URGENCY[r['urgency']].lower()}. {r['lost']} {words.with_sd(r['loss'], r['loss_sd'])}, "
            f"flights left {words.flights_left(r)}.",
        )
        for r in wanted
    )
    return join(tag("h3", "Other components"), tag("ul", *said))


def _not_known(rows: list[dict[str, Any]]) -> Html | None:
    packs = ", ".join(map(words.pack_name, rows))
    return tag("p", f"Not known: {packs}. No flight with steady cruise to judge from.") if rows else None


def _silent(gaps: list[dict[str, Any]]) -> Html | None:
    since = "; ".join(f"{g['tail']} since {words.day(g['from_at'])}" for g in gaps)
    return tag("p", f"Silent: {since}. What is said of them is as old; look for the missing files.") if gaps else None


def _summary(act: list[dict[str, Any]], plan: list[dict[str, Any]], n: int) -> str:
    if not act and not plan:
        return f"Nothing to do tonight. {words.count(n, 'pack')} watched, none with an open alert."
    first = (
        f"{words.count(len(act), 'pack')} {'needs' if len(act) == 1 else 'need'} work now"
        if act
        else "Nothing has to be done tonight"
    )
    later = f", {words.count(len(plan), 'pack')} to plan for" if plan else ""
    return f"{first}{later}. {words.count(n, 'pack')} watched."


def _item(facts: Facts, row: dict[str, Any]) -> Html:
    key = row["operator"], row["tail"], row["pack"]
    alerts = [a for a in facts.of_pack("alerts", *key).to_dicts() if a["closed_at"] is None]
    name = tag("a", words.pack_name(row), href=f"#{anchor('pack', *key)}")
    if not alerts:
        return tag("li", tag("b", name), f": no alert, but {_outlook(row)}. Look at its track.")
    wears = any(a["component"] in words.WEARS for a in alerts)
    found = "; ".join(f"{words.diagnosis(a['diagnosis'])} since {words.day(a['raised_at'])}" for a in alerts)
    todo = [words.tidy(a["recommended_action"]).rstrip(".") for a in alerts]
    return tag(
        "li",
        tag("b", name),
        f": {found}. " + (f"{_upper(_outlook(row))}. " if wears else ""),
        tag("b", "To do: "),
        ". Then: ".join(dict.fromkeys(todo)),
        ".",
    )


def _outlook(row: dict[str, Any]) -> str:
    p = row["p_event_50"]
    if (row["cc_p_event_50"] or 0) > (p or 0):
        return f"chance of a compressor message within 50 flights {words.chance(row['cc_p_event_50'])}"
    left = words.flights_left(row)
    return f"UA lost {words.loss(row)}, flights left {left}, chance of a message within 50 flights {words.chance(p)}"


def _upper(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _heard(facts: Facts) -> str:
    flights = facts["flights"]
    if not flights.height:
        return "No flight has arrived yet."
    n = flights.select("operator", "tail").n_unique()
    return f"{words.count(flights.height, 'flight')} of {n:,} aircraft; the last left on {words.clock(facts.until())}."
