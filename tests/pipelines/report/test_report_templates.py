"""Nothing that is written by others gets out of its place."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from markupsafe import Markup

from pipelines.report.templating import anchor, html_text, policy, printable, render
from pipelines.report.units import estimate, in_words, quantity

OTHERS = st.text(alphabet=st.characters(min_codepoint=32, exclude_categories=("Cs", "Cf", "Cc", "Cn")))


def document(*parts) -> str:
    page = render("document.html", title="T", parts=parts, policy=policy())
    return page.partition("<body>")[2]


def test_hostile_text_is_escaped(read, hostile):
    cells = {"kind": "table", "columns": [hostile], "rows": [[hostile]]}
    page = read(document(hostile, cells, {"kind": "verbatim", "text": hostile}))
    assert set(page.tags) == {"h1", "p", "table", "thead", "tbody", "tr", "th", "td", "pre"}
    assert page.attributes == []


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=OTHERS)
def test_text_reads_as_written(read, words):
    page = document({"kind": "verbatim", "text": words}, {"kind": "bullets", "items": [words]})
    for name in ("pre", "li"):
        within = read(page.partition(f"<{name}>")[2].partition(f"</{name}>")[0])
        assert within.text() == words.replace("\N{NO-BREAK SPACE}", " ")
        assert within.tags == []


def test_hidden_characters_show():
    assert "\u202e" not in printable("A\u202eB")
    assert "\x00" not in html_text("{a}", a="A\x00B")


@pytest.mark.parametrize(("b", "text"), [(Markup("<b>"), "a &amp; <b>"), ("<b>", "a &amp; &lt;b&gt;")])
def test_markup_is_escaped_once(b, text):
    assert html_text("a & {b}", b=b) == text


@pytest.mark.parametrize(
    ("parts", "name"), [(("pack", "AQX", "LX-AAC", 2), "pack-AQX-LX-AAC-2"), (('"><b>', 1), "b-1")]
)
def test_anchor_fits_an_address(parts, name):
    assert anchor(*parts) == name


def test_words_have_both_systems():
    assert in_words("<b> 5 K") == Markup('&lt;b&gt; <span class="si">5 K</span><span class="us">9 °F</span>')


def test_quantity_has_both_systems():
    assert quantity(100.0, "°C") == Markup('<span class="si">100 °C</span><span class="us">212 °F</span>')


def test_estimate_has_both_systems():
    flow = estimate(0.5, 0.1, "kg/s")
    assert "0.5000 kg/s (0.3355 to 0.6645)" in flow
    assert "66.14 lb/min (44.38 to 87.90)" in flow


def test_estimate_mixes_no_systems():
    at = estimate(100.0, None, "W/K at 0.5 kg/s hot")
    assert "W/K" not in at.partition('class="us">')[2].partition("</span>")[0]
    assert '<span class="us">66.1 lb/min</span> hot' in at
