"""Search of `nerf help WORDS` if nothing has that name: symptoms, commands, options and settings."""

import re
from collections.abc import Iterator, Sequence
from textwrap import TextWrapper

from nerf_lightning.config.help.catalogue import Command
from nerf_lightning.config.help.pages import brief, row
from nerf_lightning.files.folders import conf_folder

MOST = 20
"""Maximum number of commands, options and settings listed."""


def search(words: Sequence[str], commands: Sequence[Command], width: int) -> str:
    """Return the entries that contain all the words, or their stems; empty if there are none."""
    begun = [re.compile(rf"\b{re.escape(_stem(word))}", re.IGNORECASE) for word in words]
    # Their help begins with `nerf NAME: what it does.`
    texts = {f"nerf {each.name}": each.template.partition(": ")[2].partition("\n\n")[0] for each in commands}
    for command in commands:
        options = (option for group in command.options.values() for option in group)
        own = (each for each in command.settings if each.text and each.is_own)
        for key, text in [*((each.key, each.meaning) for each in own), *((each.typed, each.about) for each in options)]:
            texts.setdefault(key, text)
    found = [(key, text) for key, text in texts.items() if all(word.search(f"{key} {text}") for word in begun)]
    return "\n".join([*_symptoms(begun, width), *(row(key, brief(text), width) for key, text in found[:MOST])])


def _stem(word: str) -> str:
    """Return the common stem of a family of words.

    >>> [_stem(word) for word in ("crashed", "films", "latex")]
    ['crash', 'film', 'latex']
    """
    if re.search(r"[.=]", word):  # the name of a setting
        return word
    word = word.removesuffix("s") if len(word) > 4 else word
    return word[: max(5, len(word) - 2)]


def _symptoms(begun: list[re.Pattern[str]], width: int) -> Iterator[str]:
    """Yield the matching points of the symptoms page, below their headings."""
    page = (conf_folder().parent / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    bullets = TextWrapper(width, initial_indent="  * ", subsequent_indent="    ")
    for section in page.split("\n## ")[1:]:
        heading, *points = (" ".join(part.split()) for part in section.split("\n* "))
        fitting = [point for point in points if all(word.search(f"{heading} {point}") for word in begun)]
        if fitting:
            whole = (re.sub("`.*?`", lambda command: command[0].replace(" ", "\xa0"), point) for point in fitting)
            yield "\n".join([heading, *map(bullets.fill, whole), ""]).replace("\xa0", " ")
