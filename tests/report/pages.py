"""A run's page as the standard library's parser finds it."""

import json
from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "input", "link", "br", "hr", "img"}
LOADS = {"src", "href", "srcset", "data", "action", "poster", "xlink:href"}


class Page(HTMLParser):
    """What a browser would find, by the standard library's parser."""

    def __init__(self, text):
        super().__init__()
        self.text_of: dict[str, list[str]] = {}
        self.resources: list[str] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert "".join(self.text_of["title"]).strip()
        self.data = json.loads("".join(self.text_of["data"]), parse_constant=_refuse)

    def handle_starttag(self, tag, attrs):
        named = dict(attrs)
        self.resources += [value for name, value in attrs if name in LOADS]
        if tag not in VOID:
            self._open.append(named.get("id") if tag == "script" else tag)

    def handle_endtag(self, tag):
        if tag in ("script", "style", "title", "h1", "main"):
            while self._open and self._open.pop() not in (tag, None, "data"):
                pass

    def handle_data(self, data):
        if self._open:
            self.text_of.setdefault(self._open[-1], []).append(data)
        self.words.append(data)


def _refuse(name):
    raise AssertionError(f"{name} is no JSON")


def page_data(folder: Path) -> dict:
    """The numbers in report.html of a run."""
    return Page((folder / "report.html").read_text(encoding="utf-8")).data
