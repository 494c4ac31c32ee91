"""Nothing that is written by others gets out of its place."""

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipelines.report.html import Html, anchor, join, tag, text


def test_text_and_attributes_are_escaped(read, hostile):
    page = read(tag("p", hostile, title=hostile, data_find=hostile))
    assert page.tags == ["p"]
    assert [name for _, name, _ in page.attributes] == ["title", "data-find"]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(words=st.text(alphabet=st.characters(min_codepoint=32, exclude_categories=("Cs", "Cf", "Cc", "Cn"))))
def test_a_reader_sees_what_was_written(read, words):
    page = read(tag("p", words, title=words))
    assert "".join(page.words) == words
    assert page.attributes == [("p", "title", words)]


def test_hidden_characters_show():
    assert "\u202e" not in text("A\u202eB")
    assert "\x00" not in text("A\x00B")


def test_markup_is_not_escaped_twice():
    assert join(tag("b", "a & b"), None, " < ") == "<b>a &amp; b</b> &lt; "
    assert isinstance(text(Html("<i>")), Html)


def test_anchor_is_fit_for_an_address():
    assert anchor("pack", "AQX", "LX-AAC", 2) == "pack-AQX-LX-AAC-2"
    assert anchor('"><b>', 1) == "b-1"
