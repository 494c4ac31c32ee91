"""Translate the catalog's English evidence and actions phrase by phrase.

Evidence is stored as the core wrote it. The core declares each phrase once (`hdt_core.alerts.phrases`), so each phrase
of a sentence can be matched and translated with its values; text that matches no phrase stays as it is.
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
    """List every phrase of evidence and actions, those of installed components included."""
    texts = [text for c in components().values() for text in (c.name, c.lost, c.action, c.otherwise, c.waiting)]
    names = [text for d in DIAGNOSES.values() for text in (d.name, d.action)]
    roles = [f"{role}:" for role in (*ROLES, "Else")]
    return list(dict.fromkeys([*PHRASES, *SIGNALS.values(), *CHECKS.values(), *names, *texts, *roles]))


def translate_evidence(sentence: str) -> str:
    """Translate evidence or an action into the language in use."""
    return sentence if language() == ENGLISH else _translate(sentence, language())


@cache
def _translate(sentence: str, code: str) -> str:
    parts = []
    start = 0
    while start < len(sentence):
        matches = (_match(pattern, text, sentence, start) for pattern, text in _patterns(code))
        part, start = next((match for match in matches if match), (sentence[start], start + 1))
        parts.append(part)
    return "".join(parts)


def _match(pattern: re.Pattern[str], translation: str, sentence: str, start: int) -> tuple[str, int] | None:
    """Translate the phrase that begins at `start`, in lower case within a sentence, and return it with its end."""
    match = pattern.match(sentence, start)
    if match is None or (start and sentence[start].isalnum() and sentence[start - 1].isalnum()):
        return None
    text = translation.format(**{n: translate_value(v) for n, v in match.groupdict().items() if n != "small"})
    return (text[:1].lower() + text[1:] if sentence[start:].startswith(match["small"] or "\0") else text), match.end()


def translate_value(value: str) -> str:
    """Translate a value within a phrase: figures, a name with its code, or phrases of their own."""
    if _FIGURES.fullmatch(value):
        return in_figures(value)
    if code := _CODE.fullmatch(value):
        lower = code[1][:1].lower() + code[1][1:]
        name = lower if lower in (*SIGNALS.values(), *CHECKS.values()) else code[1]
        translated = _(name)
        return f"{translated} {code[2]}"
    return translate_evidence(value)


@cache
def _patterns(code: str) -> list[tuple[re.Pattern[str], str]]:
    """Compile each phrase, the longest first, with its translation."""
    longest_first = sorted(phrases(), key=lambda p: -len(re.sub(r"\{\w+\}", "", p)))
    return [(pattern_of(p), catalog_of(code).gettext(p)) for p in longest_first]


def pattern_of(phrase: str) -> re.Pattern[str]:
    """Compile a pattern that matches a phrase with any values, its first letter also in lower case."""
    parts = re.split(r"\{(\w+)\}", phrase)
    pattern = [re.escape(p) if k % 2 == 0 else f"(?P<{p}>{_NUMBERS.get(p, _VALUE)})" for k, p in enumerate(parts)]
    if phrase[:1].isupper() and not phrase[1:2].isupper():
        pattern[0] = f"(?:{phrase[0]}|(?P<small>{phrase[0].lower()}))" + re.escape(parts[0][1:])
    else:
        pattern[0] = "(?P<small>(?!))?" + pattern[0]
    return re.compile("".join(pattern) + ("" if phrase.endswith((":", ": ")) else _ENDS))
