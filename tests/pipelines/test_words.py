"""Every word in every language: none is missing, each keeps its values; evidence is known again phrase by phrase."""

import ast
import re
import string
from io import BytesIO
from pathlib import Path

import pytest
from babel.messages.mofile import write_mo
from babel.messages.pofile import read_po

from docs import translations
from hdt_core.alerts.fault_isolation import CHANNELS
from hdt_core.alerts.phrases import CHECKS, PHRASES, SIGNALS
from hdt_core.loading import UserError
from hdt_core.tables.raw import Signals
from pipelines import words
from pipelines.report.explain import explain
from pipelines.storage.catalog import connect
from pipelines.words import languages, use_language
from pipelines.words.evidence import pattern_of, translate_evidence

OTHERS = [language for language in languages() if language != "en"]
FOLDER = Path(words.__file__).parent
SAMPLE = {"sensor": "Pack flow (pack_flow_kg_s)", "check": "pack flow between the packs (pack_flow_between_packs_ln)",
          "loss": "34 % (32 to 36)", "since": "LX-AAA_20240301_01", "odds": "above 0.99", "moved": "+1.21 K",
          "margin": "3 K below", "hot_day": "2 K above", "parts": "target +3 K, flow -2 K", "day": "2024-06-01",
          "lost": "Efficiency lost", "name": "ng_loss"}  # fmt: skip


def fields(text: str) -> list[str]:
    return sorted(name for _, name, _, _ in string.Formatter().parse(text) if name)


def forms(text) -> tuple[str, ...]:
    return (text,) if isinstance(text, str) else tuple(text)


def catalog(language: str):
    with (FOLDER / f"{language}.po").open("rb") as file:
        return read_po(file, locale=language)


@pytest.mark.parametrize("language", OTHERS)
def test_every_message_is_translated(language):
    """`python -m docs.translations` finds them anew."""
    collected, translated = ({m.id for m in c if m.id} for c in (translations.collect_messages(), catalog(language)))
    assert translated == collected
    for message in catalog(language):
        if message.id:
            assert not message.fuzzy
            assert all(forms(message.string)), message.id
            for one, translation in zip(forms(message.id), forms(message.string), strict=True):
                assert fields(translation) == fields(one), message.id
                assert translation.count("%") == one.count("%"), message.id
    compiled = BytesIO()
    write_mo(compiled, catalog(language))
    assert compiled.getvalue() == (FOLDER / f"{language}.mo").read_bytes()


def filled(phrase: str) -> str:
    return phrase.format(**{name: SAMPLE.get(name, "7") for name in fields(phrase)})


@pytest.mark.parametrize("phrase", PHRASES)
def test_phrase_gives_its_values(phrase):
    match = pattern_of(phrase).fullmatch(filled(phrase))
    assert match is not None
    values = {k: v for k, v in match.groupdict().items() if k != "small"}
    assert values == {k: SAMPLE.get(k, "7") for k in fields(phrase)}
    with use_language("de"):
        retold = translate_evidence(filled(phrase))
    to = next(m.string for m in catalog("de") if m.id == phrase)
    parts = string.Formatter().parse(to)
    assert re.fullmatch("".join(re.escape(text) + (".+" if name else "") for text, name, _, _ in parts), retold)


def test_signals_have_plain_names():
    assert set(SIGNALS) == set(Signals.columns())
    assert set(CHECKS) == {c.name for c in CHANNELS}
    with use_language("de"):
        assert words.number(-1234.5, 1) == "\N{MINUS SIGN}1\N{NO-BREAK SPACE}234,5"
        assert words.several("{n} flight", "{n} flights", 1) == "1 Flug"
    assert words.several("{n} flight", "{n} flights", 1200) == "1,200 flights"
    assert "de" in OTHERS
    with pytest.raises(UserError, match="no language xx; there are en, de"), use_language("xx"):
        pass


ENGLISH_WORDS = re.compile(r"\b(the|is|of|with|since|than|and|lost|flights|exchanger|probability|check|which)\b")


def test_german_alerts_hold_no_english(sample_home):
    with connect(sample_home) as con:
        rows = con.execute("select evidence, evidence_now, recommended_action from alerts").fetchall()
        tails = [t for (t,) in con.execute("select distinct tail from alerts").fetchall()]
    assert rows
    with use_language("de"):
        for sentence in {s for row in rows for s in row}:
            assert not ENGLISH_WORDS.search(translate_evidence(sentence)), translate_evidence(sentence)
        for tail in tails:
            assert not ENGLISH_WORDS.search(str(explain(sample_home, tail)))


@pytest.mark.parametrize("path", sorted(translations.ROOT.rglob("*.py")), ids=lambda p: p.stem)
def test_f_strings_hold_no_message(path):
    """From Python 3.12 on, strings within an f-string are collected as messages too."""
    strings = [n for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.JoinedStr)]

    calls = [c for s in strings for c in ast.walk(s) if isinstance(c, ast.Call) and isinstance(c.func, ast.Name)]

    assert not {c.func.id for c in calls} & set(translations.KEYWORDS)
