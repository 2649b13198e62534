"""Every setting of a yaml with its sentence: from what is built of it, else from the comment beside it."""

from collections.abc import Iterator
from dataclasses import dataclass

from nerf_lightning.manual.commented_yaml import Entry
from nerf_lightning.manual.constructors import Argument, Constructor, constructor
from nerf_lightning.manual.kinds import WORDS, Kind

TARGET = "_target_"


@dataclass(frozen=True)
class Setting:
    """One setting, or a section of them."""

    key: str
    """Its dotted name, as it is typed."""
    text: str
    """The value as the yaml has it; empty for a section."""
    kind: Kind
    bounds: str
    """The numbers that are taken, in words; empty where no range is declared."""
    meaning: str
    """What it does: the docstring's sentence, or the comment's where nothing of ours is built of it."""
    note: str
    """What the yaml says of this value beside that."""

    @property
    def is_section(self) -> bool:
        """Whether it holds settings and has no value of its own."""
        return not self.text


def settings_in(entry: Entry, prefix: str) -> Iterator[Setting]:
    """Yield what a section of a yaml holds, sections before what they hold."""
    maker = maker_of(entry)
    inherited = entry.comment if len(entry.below) == 1 else ""
    for key, child in entry.below.items():
        if not key.startswith("_"):
            yield from _settings(child, f"{prefix}.{key}" if prefix else key, _argument(maker, key), inherited)


def maker_of(entry: Entry) -> Constructor | None:
    """Return what a section builds, where that is ours."""
    target = entry.below.get(TARGET)
    return None if target is None else constructor(str(target.value))


def _argument(maker: Constructor | None, key: str) -> Argument | None:
    return None if maker is None else maker.arguments.get(key)


def _settings(entry: Entry, key: str, argument: Argument | None, inherited: str) -> Iterator[Setting]:
    maker = maker_of(entry)
    said = argument.meaning if argument is not None else "" if maker is None else maker.summary
    meaning, note = (said, entry.comment) if said else (entry.comment or inherited, "")
    kind = argument.kind if argument is not None else Kind("") if entry.below else _kind_of_value(entry.value)
    yield Setting(key, entry.text, kind, "" if argument is None else argument.bounds, meaning, note)
    if entry.below and maker is None:
        # A table that is one argument, such as scene.download: its sentence is that of all that is in it.
        of_all = said or (meaning if len(entry.below) == 1 else "")
        for name, child in entry.below.items():
            if not name.startswith("_"):
                yield from _settings(child, f"{key}.{name}", None, of_all)
    else:
        yield from settings_in(entry, key)


def _kind_of_value(value: object) -> Kind:
    if isinstance(value, bool):
        return Kind(WORDS["bool"], ("true", "false"))
    if isinstance(value, int | float):
        return Kind(WORDS[type(value).__name__])
    return Kind("a list" if isinstance(value, list) else "")
