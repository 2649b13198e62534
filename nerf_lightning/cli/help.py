"""`nerf help`, `nerf COMMAND --help` and `nerf completion`: answered from conf/ and docstrings, without Hydra.

The list of commands, `nerf --help`, is in main.py.

Hydra has completion scripts, too, but they compose the config at each key press, which takes seconds, and know neither
our commands nor the values of a setting.
"""

import re
from pathlib import Path

from nerf_lightning.config.help.candidates import SHELLS, candidates
from nerf_lightning.config.help.catalogue import Command, command_named, known_names
from nerf_lightning.config.help.pages import command_page, page_of
from nerf_lightning.config.help.search import search
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import terminal_width
from nerf_lightning.messages.suggestions import did_you_mean

FLAGS = ("-h", "--help")
WIDEST = 120
SCRIPTS = Path(__file__).parent / "completions"
CANDIDATES = "candidates"  # The request of the scripts, followed by the words typed so far


def help_on(name: str, arguments: list[str]) -> str:
    """Return the help of a command, or of words such as `scene=colmap` or `trainer.max_steps` that follow --help."""
    asked = max((place for place, word in enumerate(arguments) if word in FLAGS), default=-1)
    words = [word for word in arguments[asked + 1 :] if not word.startswith("-")]
    if not words:
        return command_page(_command(name), _width())
    return "\n\n".join(_page_for(word, [name]) for word in words)


def help_on_anything(words: list[str], commands: list[str]) -> str:
    """Return the help of the words: a command, or the parts and settings of the first command that has them."""
    if words[0] in commands:
        return help_on(words[0], words[1:])
    pages = [_in_every_command(word, commands) for word in words]
    order = sorted(commands, key=lambda name: name != "train")
    searched = list(map(_command, order))
    found = "" if all(pages) else search(words, searched, _width())
    if not found and len(words) > 1 and not all(pages) and not re.search(r"[.=]", "".join(words)):
        known = (word for word in words if search([word], searched, _width()))
        fewer = next((f"Use fewer, such as nerf help {word}." for word in known), "nerf --help lists the commands.")
        raise InputError(f"Nothing in the help has all these words: {' '.join(words)}. {fewer}")
    return found or "\n\n".join(page or _page_for(word, order) for word, page in zip(words, pages, strict=True))


def _in_every_command(word: str, commands: list[str]) -> str:
    """Return the help of a word in training; if it has no meaning there, in each other command."""
    pages = {name: page_of(_command(name), word, _width()) for name in commands}
    told = {page: name for name, page in pages.items() if page}
    if len(told) < 2 or pages["train"]:
        return pages["train"] or next(iter(told), "")
    return "\n\n".join(f"nerf {name}: {page}" for page, name in told.items())


def _page_for(word: str, names: list[str]) -> str:
    for name in names:
        page = page_of(_command(name), word, _width())
        if page is not None:
            return page
    known = {each for name in names for each in known_names(_command(name))}
    where = f"nerf {names[0]} has" if len(names) == 1 else "There is"
    raise InputError(f"{where} no setting or group {word}.{did_you_mean(word.partition('=')[0], sorted(known))}")


def _command(name: str) -> Command:
    found = command_named(name)
    assert found is not None
    return found


def _width() -> int:
    return min(terminal_width(WIDEST), WIDEST)


def completion(arguments: list[str], commands: list[str]) -> str:
    """Return a shell's completion script, or, when called by a script, the completions of the last word."""
    if arguments[:1] == [CANDIDATES]:
        return "\n".join(candidates(arguments[1:], commands))
    shell = arguments[0] if arguments else ""
    if shell not in SHELLS:
        told = f"There is no completion for '{shell}'." if shell else "Completion of which shell?"
        raise InputError(f"{told}{did_you_mean(shell, SHELLS)} nerf completion bash, zsh or fish prints its script.")
    return (SCRIPTS / f"nerf.{shell}").read_text(encoding="utf-8").rstrip()
