"""Escape output: names from files stay text in a terminal, a page, a table, and another program's file.

Names of photographs, models or runs are untrusted, and may contain escape sequences, markup or formulas. These are
shown, as Python would write them, and never interpreted.
"""

import html
import logging
import re
import shutil
import unicodedata
from collections.abc import Iterable
from typing import Any

from nerf_lightning.messages.errors import InputError

FORMULAS = ("=", "+", "-", "@", "\t", "\r", "\n", "＝", "＋", "－", "＠")  # the full-width ones count in some languages
"""Characters that begin a formula in spreadsheets."""
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
MARKUP = re.compile(r"[\\`*\[\]|~$]|(?<![^\W_])_|_(?![^\W_])|^[#+=-]|^\d{1,9}[.)](?=\s|$)")
"""Matches Markdown markup, the latter alternatives only at the beginning of a text."""
ADDRESS = re.compile(r"(?<=:)/(?=/)|(?<=www)\.", re.IGNORECASE)
UNPRINTABLE = ("Cc", "Cs", "Zl", "Zp")
"""Unicode categories of control characters, lone surrogates (bytes that are not UTF-8), and line separators."""
JOINERS = "\u200c\u200d"
NARROWEST = 60  # Minimum number of columns to which text is wrapped
MOST_CHARACTERS = 1024  # Of the name of a photograph or of a scene


def for_terminal(text: str, most: int | None = None) -> str:
    r"""Return a text in one line without terminal control, truncated after `most` characters.

    Control characters, line ends, bidirectional marks, and lone surrogates are escaped as in Python.

    >>> for_terminal("a\x1b[2Jb\nc"), for_terminal("abc", 2)
    ('a\\x1b[2Jb\\nc', 'ab…')
    """
    text = text if most is None or len(text) <= most else f"{text[:most]}…"
    return text if text.isprintable() else "".join(map(_visible, text))


def for_html(text: str) -> str:
    r"""Return a text escaped for HTML, within an element or a quoted attribute; line ends stay.

    >>> for_html("<a href='x'>\x00")
    '&lt;a href=&#x27;x&#x27;&gt;\\x00'
    """
    return html.escape("\n".join(map(for_terminal, text.split("\n"))))


def for_markdown(text: str) -> str:
    r"""Return a text escaped for a paragraph or table cell of Markdown: no markup, HTML, link, picture or code.

    >>> for_markdown("fast_proposal *a* [b](c) | <d>")
    'fast_proposal \\*a\\* \\[b\\](c) \\| &lt;d&gt;'
    """
    text = html.escape(for_terminal(text).strip(), quote=False)
    # An underscore between letters, of which our names have many, is not markup.
    text = MARKUP.sub(lambda match: f"{match[0][:-1]}\\{match[0][-1]}", text)
    # URLs become links without any markup.
    return ADDRESS.sub(lambda match: f"&#{ord(match[0])};", text)


def as_code(text: str) -> str:
    """Return a text as a code span of Markdown, in which nothing is markup, HTML, a link, or, in MDX, code to run.

    >>> as_code("<b>`x`</b>")
    '`` <b>`x`</b> ``'
    """
    fence = "`" * (1 + max(map(len, re.findall("`+", text)), default=0))
    return f"{fence} {for_terminal(text, 5000)} {fence}"


def for_csv(value: Any) -> Any:
    r"""Return a value as a cell of a CSV file: a text that spreadsheets would read as a formula is quoted.

    >>> [for_csv(value) for value in ("=1+1", "-1.5", "-a", 2.0)]
    ["'=1+1", '-1.5', "'-a", 2.0]
    """
    if not isinstance(value, str):
        return value
    is_formula = value.startswith(FORMULAS) and not NUMBER.fullmatch(value)
    return f"'{for_terminal(value)}" if is_formula else for_terminal(value)


def terminal_width(otherwise: int) -> int:
    """Return the number of columns to which text is wrapped: the terminal's, or `otherwise` without one."""
    return max(shutil.get_terminal_size((otherwise, 24)).columns, NARROWEST)


def is_plain(name: str) -> bool:
    """Return whether a name is UTF-8 without control characters."""
    return name.isprintable() or not any(unicodedata.category(letter) in UNPRINTABLE for letter in name)


def require_printable(name: str, where: str) -> None:
    """Refuse a name for `where` that is too long, not UTF-8, or contains control characters."""
    if len(name) > MOST_CHARACTERS or not is_plain(name):
        raise InputError(
            f"{where} has the name '{for_terminal(name[:200])}', which holds control characters, is not UTF-8 or has "
            f"more than {MOST_CHARACTERS} characters. Rename it, also in the files that list it."
        )


class EscapingFormatter(logging.Formatter):
    """Format log records so that whatever their messages contain stays text; only tracebacks take several lines."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        """Return the line of a record; Hydra indents its own with a tab."""
        text = record.message.lstrip("\t")
        record.message = "  " * (len(record.message) - len(text)) + for_terminal(text)
        return super().formatMessage(record)

    def formatException(self, ei: Any) -> str:
        """Return a traceback."""
        return "\n".join(map(for_terminal, super().formatException(ei).split("\n")))


def _visible(letter: str) -> str:
    # Spaces of other widths, and joiners in Persian, in Indian languages and in emojis, are harmless.
    is_harmless = letter.isprintable() or letter in JOINERS or unicodedata.category(letter) == "Zs"
    return letter if is_harmless else letter.encode("unicode_escape").decode("ascii")


def listed(items: Iterable[object], cap: int = 10) -> str:
    """Return the items separated by commas in one line, at most `cap` of them.

    >>> listed([1, 2, 3, 4], cap=2)
    '1, 2 and 2 more'
    """
    names = [for_terminal(str(item)) for item in items]
    shown = ", ".join(names[:cap])
    return shown if len(names) <= cap else f"{shown} and {len(names) - cap} more"
