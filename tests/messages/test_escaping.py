"""Names from files stay text wherever they are shown; how far something is is told where no terminal shows a bar."""

import csv
import html
import io
import itertools
import logging
import os
import re
import unicodedata
from html.parser import HTMLParser

import pytest
from hypothesis import given
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from nerf_lightning.messages import console
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import (
    JOINERS,
    EscapingFormatter,
    for_csv,
    for_html,
    for_markdown,
    for_terminal,
    require_printable,
)

ANYTHING = st.text(st.characters()) | st.text(st.sampled_from("\x1b\x9b\x00\n\r\t\u202e\u2028\udcff\u00a0 a1_"))
MARKUP = st.text(st.sampled_from("`*_[]()!<>|~#+-=.&\\:/@$ a1w\n")) | st.sampled_from(
    ["https://a.b", "www.a.b", "1. a", "    a", "# a", "---", "```", "<b>", "&lt;", "![a](b)", "a\n===", "|a|b|"]
)


@given(ANYTHING)
def test_nothing_reaches_a_terminal_but_letters(text):
    shown = for_terminal(text)
    assert all(letter.isprintable() or unicodedata.category(letter) == "Zs" or letter in JOINERS for letter in shown)
    assert len(shown.splitlines()) <= 1
    shown.encode()
    assert for_terminal(shown) == shown


@given(st.text(st.characters(codec="ascii", exclude_categories=["Cc"])))
def test_plain_text_is_shown_as_it_is(text):
    assert for_terminal(text) == text


@given(ANYTHING | MARKUP)
def test_html_shows_the_text(text):
    page = Page()
    page.feed(f"<p title=\"{for_html(text)}\" lang='{for_html(text)}'>{for_html(text)}</p>")
    page.close()
    shown = "\n".join(map(for_terminal, text.split("\n")))
    assert page.seen == ["p", "/p"]
    assert page.attributes == [("title", shown), ("lang", shown)]
    assert page.text == shown


class Page(HTMLParser):
    def __init__(self):
        super().__init__()
        self.seen, self.attributes, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.seen.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        self.seen.append(f"/{tag}")

    def handle_data(self, data):
        self.text += data


@given(ANYTHING | MARKUP)
def test_markdown_shows_the_text(text):
    markdown = MarkdownIt("commonmark").enable(["table", "strikethrough"])
    shown = for_terminal(text).strip()
    page = markdown.render(for_markdown(text))
    assert html.unescape(page) == (f"<p>{shown}</p>\n" if shown else "")
    row = markdown.render(f"| a | b |\n| --- | --- |\n| {for_markdown(text)} | x |\n")
    assert [html.unescape(cell) for cell in re.findall("<td>(.*)</td>", row)] == [shown, "x"]


def test_addresses_in_markdown_are_no_links_formulas_are_quoted_and_numbers_left():
    assert for_markdown("see https://a.b and www.a.b") == "see https:&#47;/a.b and www&#46;a.b"
    for text in ("=1", "+a", "-a", "--1", "@a", "\t=1", "\r=1", "-1+1"):
        assert for_csv(text) == f"'{for_terminal(text)}"
    for text in ("-1.5", "+3", "1e-3", "-2E5", "a=1", ""):
        assert for_csv(text) == text


@given(st.lists(ANYTHING | MARKUP | st.floats(allow_nan=False), min_size=1))
def test_no_cell_of_a_csv_file_is_a_formula(values):
    file = io.StringIO(newline="")
    csv.writer(file).writerow([for_csv(value) for value in values])
    (row,) = csv.reader(io.StringIO(file.getvalue(), newline=""))
    for value, cell in zip(values, row, strict=True):
        if isinstance(value, float):
            assert float(cell) == value
        else:
            assert cell.removeprefix("'") == for_terminal(value).removeprefix("'")
            assert not cell.startswith(("=", "+", "-", "@", "\t", "\r")) or float(cell) is not None


@pytest.mark.parametrize("name", ["a\nb", "a\x1b[2J", "a\x00", "\x85", "\u2028", os.fsdecode(b"\xff.png"), "\ud800"])
def test_names_with_control_characters_are_refused(name):
    with pytest.raises(InputError, match=r"^photograph 3 of x has the name '.*\\.*', which holds control") as caught:
        require_printable(name, "photograph 3 of x")
    assert str(caught.value).isprintable()


def test_names_of_all_languages_are_taken():
    for name in ("a b.png", "Schloß/übung_1.png", "写真　1.jpg", "at 9.41\u202fAM.png", "👨\u200d👩\u200d👧.png"):
        require_printable(name, "a photograph")


def test_log_messages_stay_in_their_line():
    record = logging.LogRecord("a", logging.INFO, "f", 1, "read %s", ("\x1b[2Jx\nERROR y",), None)
    formatter = EscapingFormatter("%(levelname)s %(message)s")
    indented = logging.LogRecord("a", logging.INFO, "f", 1, "\t#0 : a\tb", (), None)
    assert formatter.format(indented) == "INFO   #0 : a\\tb"
    assert formatter.format(record) == r"INFO read \x1b[2Jx\nERROR y"
    try:
        raise ValueError("\x1b[2J")
    except ValueError as error:
        record.exc_info = (type(error), error, error.__traceback__)
    lines = formatter.format(record).splitlines()
    assert lines[1].startswith("Traceback")
    assert lines[-1] == r"ValueError: \x1b[2J"


@pytest.fixture
def told(monkeypatch, caplog):
    """Let every reading of the clock be 20 s later; return what was told."""
    clock = itertools.count(0.0, 20.0)
    monkeypatch.setattr(console.time, "monotonic", lambda: next(clock))
    caplog.set_level(logging.INFO)
    return lambda: [record.getMessage() for record in caplog.records]


def test_items_that_take_long_are_told_in_lines(told):
    assert list(console.tracked(range(5), "filming")) == [0, 1, 2, 3, 4]
    assert told() == ["filming: 20 %, about 2 min 40 s left", "filming: 60 %, about 53 s left"]


def test_the_time_left_is_not_told_of_what_has_only_begun(told):
    lines = console.ProgressLines()
    for fraction in (0.02, 0.02, 0.05, 0.05):
        lines("surfaces", fraction)
    assert told() == ["surfaces: 2 %", "surfaces: 5 %, about 25 min 20 s left"]


def test_stages_are_told_in_lines_with_the_share_of_the_whole(told):
    with console.StageProgress({"matching": 3.0, "reconstruction": 1.0}) as report:
        for stage, fraction in (("matching", 0.0), ("matching", 0.5), ("reconstruction", 0.0), ("reconstruction", 1.0)):
            report(stage, fraction)
    assert [line.partition(", about")[0] for line in told()] == ["matching: 38 %"]


def test_nobody_is_told_of_what_is_quick(monkeypatch, caplog):
    caplog.set_level(logging.INFO)
    list(console.tracked(range(1000), "filming"))
    assert not caplog.records
