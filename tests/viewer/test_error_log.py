"""Text of strangers, shown as text."""

import re

from hypothesis import given
from hypothesis import strategies as st

from nerf_lightning.viewer.error_log import as_plain_markdown, one_line


@given(st.text())
def test_nothing_ends_the_code_span_early(text):
    """CommonMark 6.1: a code span ends at the first run of backticks as long as the one that began it."""
    shown = as_plain_markdown(text)
    fence = re.match("`+", shown)[0]
    inner = shown[len(fence) : -len(fence)]
    assert inner.strip(" ") == one_line(text).strip(" ")
    assert all(len(run) != len(fence) for run in re.findall("`+", inner))
    assert not inner.startswith("`")
    assert not inner.endswith("`")
    assert inner.isprintable()


def test_surrogates_and_line_ends_are_shown_as_something_and_long_texts_are_cut():
    assert as_plain_markdown("a\udc80\n\nb\u202e") == "`a\ufffd  b\ufffd`"
    assert one_line("a" * 10**6, 3) == "aaa…"
