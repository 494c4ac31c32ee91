"""Every word in every language: none is missing, each keeps its values, in evidence too."""

import ast
import re
import string
from io import BytesIO
from pathlib import Path

import pytest
from answers import query
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po

from docs import translations
from hdt_core.alerts.evidence import Corroboration, Evidence
from hdt_core.alerts.fault_isolation import CHANNELS
from hdt_core.alerts.phrases import CHECKS, SIGNALS
from hdt_core.alerts.text import Figures, Phrase, Text, TextList, declared_phrases, to_json
from hdt_core.components.pack import HX
from hdt_core.loading import UserError
from hdt_core.tables.raw import Signals
from pipelines import words
from pipelines.report.explain import explain
from pipelines.words import languages, use_language
from pipelines.words.evidence import WITH_COLUMNS, action_text, evidence_text

OTHERS = [language for language in languages() if language != "en"]
FOLDER = Path(words.__file__).parent


def fields(text: str) -> list[str]:
    return sorted(name for _, name, _, _ in string.Formatter().parse(text) if name)


def forms(text) -> tuple[str, ...]:
    return (text,) if isinstance(text, str) else tuple(text)


def catalog(language: str):
    with (FOLDER / f"{language}.po").open("rb") as file:
        return read_po(file, locale=language)


@pytest.mark.parametrize("language", OTHERS)
def test_every_message_is_translated(language):
    """`python -m docs.translations` finds them anew; none is left over."""
    collected, translated = ({m.id for m in c if m.id} for c in (translations.collect_messages(), catalog(language)))
    assert translated == collected


@pytest.mark.parametrize("language", OTHERS)
def test_translation_keeps_its_values(language):
    for message in catalog(language):
        if message.id:
            assert not message.fuzzy
            assert all(forms(message.string)), message.id
            for one, translation in zip(forms(message.id), forms(message.string), strict=True):
                assert fields(translation) == fields(one), message.id
                assert translation.count("%") == one.count("%"), message.id


@pytest.mark.parametrize("language", OTHERS)
def test_translations_are_compiled(language):
    compiled = BytesIO()
    write_mo(compiled, catalog(language))
    assert compiled.getvalue() == (FOLDER / f"{language}.mo").read_bytes()


def stored(*texts: Text) -> str:
    return to_json(TextList(texts, "; "))


@pytest.mark.parametrize("phrase", [Phrase(p) for p in declared_phrases() if "{" in p])
def test_phrase_keeps_values_in_translation(phrase):
    text = Text(phrase, **{name: f"<{name}>" for name in fields(phrase) if "_" not in name})

    with use_language("de"):
        german = action_text(stored(text), WITH_COLUMNS)

    assert [value for value in text.values.values() if value not in german] == []


def test_columns_are_left_out():
    text = Text("Heat transfer lost{hx_fouling} {loss}: wear alone does not explain it", loss="34 %")

    assert action_text(stored(text)) == "Heat transfer lost 34 %: wear alone does not explain it"


def test_continued_text_begins_small():
    action = stored(Text("Only then"), Text.whole(HX.action).continued())

    assert action_text(action) == f"Only then; w{HX.action[1:]}"


def test_declared_text_keeps_its_braces():
    assert action_text(stored(Text.whole("Set {x} to 1"))) == "Set {x} to 1"


def test_figures_follow_the_language():
    text = stored(Text("{moved} since {since}", moved=Figures("-1.21", "K"), since="LX-AAA_20240301_01"))

    with use_language("de"):
        assert action_text(text) == "\N{MINUS SIGN}1,21 K since LX-AAA_20240301_01"


def test_alternatives_are_left_out():
    corroboration = Corroboration("Supports", "door position unknown")
    evidence = Evidence((Text("lost {loss}", loss="34 %"),), (corroboration,), "a sensor", "Waiting costs")

    assert evidence_text(evidence.to_json(), has_alternatives=False) == "Lost 34 %. Supports: door position unknown."


def test_english_is_the_stored_paragraph(sample_home):
    rows = query(sample_home, "select evidence, evidence_phrases from alerts")

    assert [evidence_text(phrases, WITH_COLUMNS).replace("\N{MINUS SIGN}", "-") for _, phrases in rows] == [
        evidence for evidence, _ in rows
    ]


def test_signals_have_plain_names():
    assert set(SIGNALS) == set(Signals.columns())
    assert set(CHECKS) == {c.name for c in CHANNELS}


def test_german_number_has_its_form():
    with use_language("de"):
        assert words.number(-1234.5, 1) == "\N{MINUS SIGN}1\N{NO-BREAK SPACE}234,5"


@pytest.mark.parametrize(("language", "n", "text"), [("de", 1, "1 Flug"), ("en", 1200, "1,200 flights")])
def test_noun_has_its_plural(language, n, text):
    with use_language(language):
        assert words.several("{n} flight", "{n} flights", n) == text


def test_unknown_language_is_refused():
    assert "de" in OTHERS
    with pytest.raises(UserError, match="no language xx; there are en, de"), use_language("xx"):
        pass


ENGLISH_WORDS = re.compile(r"\b(the|is|of|with|since|than|and|lost|flights|exchanger|probability|check|which)\b")


def test_german_alerts_hold_no_english(sample_home):
    rows = query(sample_home, "select evidence_phrases, evidence_now_phrases, action_phrases from alerts")
    tails = [t for (t,) in query(sample_home, "select distinct tail from alerts")]
    assert rows
    with use_language("de"):
        texts = [f"{evidence_text(first)} {evidence_text(now)} {action_text(action)}" for first, now, action in rows]
        assert [text for text in texts if ENGLISH_WORDS.search(text)] == []
        for tail in tails:
            assert not ENGLISH_WORDS.search(str(explain(sample_home, tail)))


@pytest.mark.parametrize("path", sorted(translations.ROOT.rglob("*.py")), ids=lambda p: p.stem)
def test_f_strings_hold_no_message(path):
    """From Python 3.12 on, strings within an f-string are collected as messages too."""
    strings = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.JoinedStr)]

    calls = [c for s in strings for c in ast.walk(s) if isinstance(c, ast.Call) and isinstance(c.func, ast.Name)]

    assert not {c.func.id for c in calls} & set(translations.KEYWORDS)
