"""What the catalog says in English - evidence and actions - said in another language, phrase by phrase.

Evidence is stored as the core wrote it. The core declares each phrase once (`hdt_core.alerts.phrases`), so a phrase is
known again wherever it stands in a sentence, and its values are taken over; what is no such phrase stays as it is.
"""

import re
from functools import cache

from hdt_core.alerts.diagnoses import DIAGNOSES
from hdt_core.alerts.evidence import ROLES
from hdt_core.alerts.phrases import CHECKS, PHRASES, SIGNALS
from hdt_core.components import components
from pipelines.words import ENGLISH, _, catalog_of, in_figures, language

_FIGURES = re.compile(r"[+\-]?\d+(?:\.\d+)?")
_CODE = re.compile(r"(.*) (\((?:[a-z]+\d*_)+[a-z0-9]+\))")
_VALUE = r"(?! )(?:(?!; |\. ).)+?"
_NUMBERS = dict.fromkeys(
    ("days", "high", "k", "level", "limit", "low", "points", "share", "sigma", "stop", "units", "value"),
    _FIGURES.pattern,
)
"""Values that are figures; others may be a name or a phrase, within a clause."""
_ENDS = r"(?=$|[;,.:)](?:\s|$)|;| \()"


def phrases() -> list[str]:
    """Every phrase that evidence and actions are made of, components of other packages included."""
    declared = [text for c in components().values() for text in (c.name, c.lost, c.action, c.otherwise, c.waiting)]
    named = [text for d in DIAGNOSES.values() for text in (d.name, d.action)]
    roles = [f"{role}:" for role in (*ROLES, "Else")]
    return list(dict.fromkeys([*PHRASES.values(), *SIGNALS.values(), *CHECKS.values(), *named, *declared, *roles]))


def retold(sentence: str) -> str:
    """Evidence or an action in the language spoken."""
    return sentence if language() == ENGLISH else _retold(sentence, language())


@cache
def _retold(sentence: str, spoken: str) -> str:
    told, at = [], 0
    while at < len(sentence):
        found = next((hit for pattern, to in _patterns(spoken) if (hit := _at(pattern, to, sentence, at))), None)
        if found is None:
            told.append(sentence[at])
            at += 1
        else:
            told.append(found[0])
            at = found[1]
    return "".join(told)


def _at(pattern: re.Pattern[str], to: str, sentence: str, at: int) -> tuple[str, int] | None:
    """A phrase retold, and where it ends, where it begins at `at`; small where it stands within a sentence."""
    found = pattern.match(sentence, at)
    if found is None or (at and sentence[at].isalnum() and sentence[at - 1].isalnum()):
        return None
    told = to.format(**{n: value_retold(v) for n, v in found.groupdict().items() if n != "small"})
    return (told[:1].lower() + told[1:] if sentence[at:].startswith(found["small"] or "\0") else told), found.end()


def value_retold(value: str) -> str:
    """What stands in a phrase: figures, a name with its code, or phrases of their own."""
    if _FIGURES.fullmatch(value):
        return in_figures(value)
    named = _CODE.fullmatch(value)
    if named:
        plain = named[1][:1].lower() + named[1][1:]
        known = plain if plain in (*SIGNALS.values(), *CHECKS.values()) else named[1]
        return f"{_(known)} {named[2]}"
    return retold(value)


@cache
def _patterns(spoken: str) -> list[tuple[re.Pattern[str], str]]:
    """Phrases as they are looked for, the longest first, each with its translation."""
    known = sorted(phrases(), key=lambda p: -len(re.sub(r"\{\w+\}", "", p)))
    return [(pattern_of(p), catalog_of(spoken).gettext(p)) for p in known]


def pattern_of(phrase: str) -> re.Pattern[str]:
    """What finds a phrase whatever its values are, and where it begins with a small letter instead of its capital."""
    parts = re.split(r"\{(\w+)\}", phrase)
    looked_for = [re.escape(p) if k % 2 == 0 else f"(?P<{p}>{_NUMBERS.get(p, _VALUE)})" for k, p in enumerate(parts)]
    if phrase[:1].isupper() and not phrase[1:2].isupper():
        looked_for[0] = f"(?:{phrase[0]}|(?P<small>{phrase[0].lower()}))" + re.escape(parts[0][1:])
    else:
        looked_for[0] = "(?P<small>(?!))?" + looked_for[0]
    return re.compile("".join(looked_for) + ("" if phrase.endswith((":", ": ")) else _ENDS))
