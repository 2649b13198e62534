"""What a command can be told: its groups with their options, and all settings, read from conf/ without Hydra."""

from dataclasses import dataclass
from functools import cache, cached_property

from nerf_lightning.files.folders import conf_file, option_names
from nerf_lightning.manual.commented_yaml import CommentedYaml, Entry, brief, read_commented
from nerf_lightning.manual.settings import Setting, maker_of, settings_in

OF_SWEEPS = ("hydra/launcher", "hydra/sweeper")
"""Groups of Hydra to which conf/ adds options: any command may be swept with -m."""


@dataclass(frozen=True)
class Option:
    """One yaml of a group, put where a command has the group."""

    group: str
    name: str
    place: str
    """The section that it fills; empty for one whose keys stand for themselves."""
    file: CommentedYaml
    entry: Entry
    """Its settings, those included that it has from the options it is based on."""
    chosen: dict[str, str]
    """What it chooses of other groups, by the place."""

    @property
    def summary(self) -> str:
        """What it is, in one line: its yaml's first sentence, else that of the class it builds."""
        maker = maker_of(self.entry)
        return brief(self.file.header or ("" if maker is None else maker.summary))

    @cached_property
    def settings(self) -> list[Setting]:
        """Its own settings, and those of the options that it chooses for parts of itself."""
        own = list(settings_in(self.entry, self.place))
        placed = ((place, name) for place, name in self.chosen.items() if "@" in place)
        return own + [
            setting
            for place, name in placed
            for setting in option(place.partition("@")[0], name, place.partition("@")[2]).settings
        ]


@dataclass(frozen=True)
class Group:
    """A group of options as a command has it."""

    name: str
    """Its folder in conf/."""
    place: str
    """The section that it fills."""
    chosen: str | None
    """The option where nobody chooses."""

    @property
    def typed(self) -> str:
        """What a person types before `=`."""
        return self.name if self.place == self.name.replace("/", ".") else f"{self.name}@{self.place}"

    @property
    def options(self) -> list[Option]:
        """All of them, by name."""
        return [option(self.name, name, self.place) for name in option_names(self.name)]


@dataclass(frozen=True)
class Command:
    """What one command has."""

    name: str
    file: CommentedYaml

    @cached_property
    def groups(self) -> list[Group]:
        """Its groups, in the order of its defaults list."""
        listed = (_group(typed, chosen) for typed, chosen in self.file.defaults if typed != "_self_")
        return [group for group in listed if group.name != "hydra"]

    @cached_property
    def brought(self) -> list[Group]:
        """The groups that its options have for parts of theirs, such as the sampler of a level."""
        chosen = (pair for group in self.groups for each in group.options for pair in each.chosen.items())
        places = {group.typed for group in self.groups}
        typed = dict.fromkeys(typed for typed, _ in chosen if "@" in typed and typed not in places)
        return [_group(each, None) for each in (*typed, *OF_SWEEPS)]

    @cached_property
    def own(self) -> list[Setting]:
        """The settings that stand in its own yaml, without what it sets of its groups."""
        return [each for each in self._written if _root(each.key) not in self._places]

    @cached_property
    def settings(self) -> list[tuple[Option | None, Setting]]:
        """Every setting, with the option that has it; None for the command itself.

        What an option only sets, and another group has, is left out: `assignments` has it.
        """
        return self._settings([*self.groups, *self.brought])

    def settings_below(self, root: str) -> list[tuple[Option | None, Setting]]:
        """Return those of them that begin with a word such as `trainer`: far fewer files are read for it."""
        return self._settings([group for group in (*self.groups, *self.brought) if _root(group.place) == root])

    def _settings(self, groups: list[Group]) -> list[tuple[Option | None, Setting]]:
        found: dict[tuple[str, str, str], tuple[Option | None, Setting]] = {
            ("", "", s.key): (None, s) for s in self.own
        }
        for group in groups:
            for each in group.options:
                for setting in each.settings:
                    if _root(setting.key) == _root(group.place):
                        found.setdefault((group.name, each.name, setting.key), (each, setting))
        return list(found.values())

    @cached_property
    def chosen(self) -> dict[str, Option]:
        """The options that it has where nothing is said, by what is typed for their group."""
        names = {group.typed: group.chosen for group in self.groups}
        options: dict[str, Option] = {}
        for _ in self.groups:  # what is chosen may choose in its turn
            options = {
                group.typed: option(group.name, names[group.typed], group.place)
                for group in self.groups
                if names[group.typed]
            }
            names |= {typed: name for each in options.values() for typed, name in each.chosen.items() if typed in names}
        return options

    def default(self, key: str) -> str:
        """Return the value that a setting has where nothing is said; of several options', the first one's.

        Raises:
            KeyError: there is no such setting.
        """
        own = (each.text for each in self._written if each.key == key)
        by_models = (
            each.text
            for found in self.chosen.values()
            if found.file.is_global
            for each in found.settings
            if each.key == key
        )
        by_groups = (each.text for found in self.chosen.values() for each in found.settings if each.key == key)
        anywhere = (each.text for _, each in self.settings if each.key == key)
        for text in (*own, *by_models, *by_groups, *anywhere):
            return text
        raise KeyError(key)

    def assignments(self, key: str) -> list[tuple[str, str]]:
        """Return who sets a setting of another group, such as `model=fast`, and to what; the command itself first."""
        found = [
            (f"nerf {self.name}", each.text) for each in self._written if each.key == key and _root(key) in self._places
        ]
        for group in (group for group in self.groups if group.place != _root(key)):
            for each in (each for each in group.options if each.file.is_global):
                found += [
                    (f"{group.typed}={each.name}", setting.text) for setting in each.settings if setting.key == key
                ]
        return found

    @cached_property
    def _written(self) -> list[Setting]:
        return list(settings_in(self.file.root, ""))

    @cached_property
    def _places(self) -> set[str]:
        return {group.place for group in self.groups} | {"hydra"}


@cache
def command_named(name: str) -> Command | None:
    """Return what a command has; None where there is none of the name."""
    file = conf_file(name)
    return Command(name, read_commented(file)) if file.is_file() else None


@cache
def option(group: str, name: str, place: str) -> Option:
    """Return an option of a group, as it fills a section."""
    file = read_commented(conf_file(f"{group}/{name}"))
    entry, chosen = _resolved(file, group, "" if file.is_global else place)
    return Option(group, name, "" if file.is_global else place, file, entry, chosen)


def _resolved(file: CommentedYaml, group: str, place: str) -> tuple[Entry, dict[str, str]]:
    """Return a yaml's settings over those of the options that it is based on, and what all of them choose."""
    entry, chosen = Entry(), {}
    for typed, name in file.defaults:
        typed = typed.removeprefix("override ")
        base = conf_file((typed[1:] if typed.startswith("/") else f"{group}/{typed}").removesuffix("@_here_"))
        if name is not None:
            name_of_group, _, below = typed.removeprefix("/").partition("@")
            where = ".".join(filter(None, (place, below))) if below else ""
            chosen[f"{name_of_group}@{where}" if where else name_of_group] = name
        elif base.is_file():
            theirs, also = _resolved(read_commented(base), group, place)
            entry, chosen = theirs.over(entry), chosen | also
    return file.root.over(entry), chosen


def _group(typed: str, chosen: str | None) -> Group:
    name, _, place = typed.partition("@")
    return Group(name, place or name.replace("/", "."), chosen)


def _root(key: str) -> str:
    return key.partition(".")[0]
