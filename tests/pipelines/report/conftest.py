"""How the tests read a page."""

from html.parser import HTMLParser

import pytest

VOID = {"meta", "link", "input", "br", "img"}


class Reader(HTMLParser):
    """Tags, attributes and text of a page, as a browser would read them; says which tags were left open."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.tags = []
        self.attributes = []
        self.words = []
        self.open = []
        self.crossed = []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, *a) for a in attrs]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.crossed.append(tag)

    def handle_data(self, data):
        if not self.open or self.open[-1] not in {"script", "style"}:
            self.words.append(data)

    def values(self, name: str) -> list[str]:
        """Values of one attribute wherever it stands."""
        return [value for _, attribute, value in self.attributes if attribute == name]

    def text(self) -> str:
        """Words, those between which no line breaks as others."""
        return "".join(self.words).replace("\N{NO-BREAK SPACE}", " ")


@pytest.fixture(scope="session")
def read():
    """Parse a page."""

    def parse(page: str) -> Reader:
        reader = Reader()
        reader.feed(page)
        reader.close()
        return reader

    return parse


@pytest.fixture(scope="session")
def hostile() -> str:
    """A name that tries to be markup and to turn the text round."""
    return '"\'></svg></script><script>alert(1)</script><img src=x onerror="x()">\x00\u202e'
