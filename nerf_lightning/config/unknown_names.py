"""What is said of settings, groups and options that do not exist: near names, in the place of Hydra's own words."""

import re

from nerf_lightning.config.manual.catalogue import Command, command_named, known_names
from nerf_lightning.config.manual.suggestions import did_you_mean, near
from nerf_lightning.config.overrides import PLAIN
from nerf_lightning.files.folders import option_names

KEY = re.compile(r"Could not override '(?P<key>[^']+)'(?:.* use \+(?P=key)=(?P<value>.*))?")
DELETED = re.compile(r"Could not delete(?: from config\.)? '(?P<key>[^']+)'(?P<value>)")
OPTION = re.compile(r"Could not find '([^']+)/([^'/]+)'")


def unknown_name(message: str, command: str) -> str | None:
    """Return what to say instead of Hydra's message; None where it is of something else.

    Args:
        message: Hydra's, as one line.
        command: the command that was given the name.
    """
    asked = command_named(command)
    if asked is None:
        return None
    option, key = OPTION.search(message), KEY.search(message) or DELETED.search(message)
    if option is not None:
        return _no_option(*option.groups())
    return None if key is None else _no_setting(key["key"], key["value"], asked)


def _no_option(group: str, name: str) -> str | None:
    options = option_names(group)
    if not options:  # not ours: of a folder that hydra.searchpath names, or of a plugin
        return None
    cure = did_you_mean(name, options, f"{group}=") or f" Its options are {', '.join(options)}."
    return f"There is no {group}={name}.{cure} nerf help {group} tells of each."


def _no_setting(name: str, value: str | None, asked: Command) -> str:
    having = [each.source for each in asked.settings if each.key == name]
    if having:
        return f"{name} is a setting of {_listed(having)}, and something else is chosen. nerf help {name} tells of it."
    close = near(name, known_names(asked))
    told = f"nerf {asked.name} has no setting {name}."
    if close:
        given = f"={value}" if value and PLAIN.fullmatch(value) else ""
        return f"{told} Did you mean {' or '.join(f'{each}{given}' for each in close)}?"
    training = command_named("train")
    if training is not None and name in known_names(training):
        return f"{told} It belongs to training: nerf help {name}. nerf {asked.name} --help lists what {asked.name} has."
    return f"{told} nerf {asked.name} --help lists what it has; +{name}=VALUE adds one of your own."


def _listed(names: list[str], most: int = 4) -> str:
    once = list(dict.fromkeys(names))
    return ", ".join(once[:most]) + (f" and {len(once) - most} more" if len(once) > most else "")
