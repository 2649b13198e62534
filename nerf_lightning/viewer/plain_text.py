"""Text that others wrote, as text: names in a checkpoint, folders, messages of the system."""

import re

from nerf_lightning.viewer.limits import MOST_LETTERS


def as_plain_markdown(text: str, most: int = MOST_LETTERS) -> str:
    """Return markdown that shows a text and nothing else: viser's page runs the HTML that stands in markdown.

    A code span is the one place where markdown takes every letter as it is, addresses too: they become no links. What
    is not to be printed is shown as a box, and more than `most` letters are cut.

    >>> as_plain_markdown("<b>`x`</b>")
    '``<b>`x`</b>``'
    """
    shown = one_line(text, most)
    longest = max(map(len, re.findall("`+", shown)), default=0)
    fence = "`" * (longest + 1)
    beside = " " if shown[:1] in ("`", " ", "") or shown[-1:] in ("`", " ") else ""
    return f"{fence}{beside}{shown}{beside}{fence}"


def one_line(text: str, most: int = MOST_LETTERS) -> str:
    """Return a text on one line without control characters, cut where it is long.

    >>> one_line("a\\nb\\x1b[0m")
    'a b\\ufffd[0m'
    """
    cut = text if len(text) <= most else f"{text[:most]}…"
    return "".join(letter if letter.isprintable() else " " if letter.isspace() else "\ufffd" for letter in cut)
