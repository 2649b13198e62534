"""The overrides that a run was started with, repeated where it is resumed by name.

They come out of a file in the run's folder, and the folder may come from anybody: what names a class, looks something
up (an interpolation), or says where to write or how far to trust is taken from the command line alone.
"""

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from nerf_lightning.commands.plain_yaml import read_plain_yaml
from nerf_lightning.conf_folder import conf_folder
from nerf_lightning.errors import InputError

OF_ONE_START = ("resume", "paths", "init_from", "sweep")
"""What belongs to one start of a run, not to the run."""
OF_THE_USER = ("hydra", "logger", "scene.download", "scene.cache_dir", "scene.allow_outside", "scene.max_gigabytes")
"""Where to write, what to fetch, and what to trust."""
DOWNLOADED = "scene.path"
"""Where some scenes put what they fetch: a file that is there already is only read."""
OPTION = re.compile(r"[\w-]+(/[\w-]+)*", re.ASCII)
KEY = re.compile(r"[A-Za-z][\w-]*", re.ASCII)


def former_overrides(run_folder: Path, arguments: Sequence[str]) -> list[str]:
    """Return what a run was started with, but for what belongs to one start and what the user gives again.

    Raises:
        InputError: the file is no list of overrides, or holds one that is not repeated from files.
    """
    saved = run_folder / ".hydra" / "overrides.yaml"
    if not saved.is_file():
        return []
    lines = read_plain_yaml(saved)
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError(f"{saved} is no list of overrides: it is damaged. Give the run's settings by hand.")
    given = {argument.lstrip("+~").partition("=")[0] for argument in arguments}
    kept = []
    for line in lines:
        override = _parsed(line)
        key = "" if override is None else override.key_or_group
        if _belongs(key, OF_ONE_START) or key in given:
            continue
        if not _is_harmless(override):
            raise InputError(
                f"{saved} holds {line[:200]!r}, which is not repeated from a file: what names a class, looks something "
                "up, or says where to write, what to fetch and how far to trust is taken from the command line alone. "
                "If it is yours, type it again after resume=; else do not go on with this run."
            )
        kept.append(line)
    return kept


def to_give_again(overrides: Sequence[str]) -> list[str]:
    """Return, as typed in a shell, those of a run's overrides that are not repeated from its folder."""
    parsed = [(line, _parsed(line)) for line in overrides]
    return [
        shlex.quote(line)
        for line, override in parsed
        if override and not _belongs(override.key_or_group, OF_ONE_START) and not _is_harmless(override)
    ]


def _parsed(line: str) -> Override | None:
    try:
        # Options of Hydra's own command line, such as --config-dir, are none.
        return None if line.startswith("-") else OverridesParser.create().parse_override(line)
    except HydraException:
        return None


def _is_harmless(override: Override | None) -> bool:
    if override is None or override.is_sweep_override():
        return False
    key, value = override.key_or_group, override.value()
    if not all(KEY.fullmatch(word) for word in re.split(r"[./]", key)):
        return False
    if override.package is not None or "/" in key or (conf_folder() / key).is_dir():
        names = value if isinstance(value, list) else [value]
        if key.partition("/")[0] == "hydra" or not all(_is_option(name) for name in names):
            return isinstance(value, dict) and _is_plain(key, value)
        return True
    return _is_plain(key, value)


def _is_option(name: Any) -> bool:
    return name is None or (isinstance(name, str) and OPTION.fullmatch(name) is not None)


def _is_plain(key: str, value: Any) -> bool:
    for path, leaf in _leaves(key, value):
        if _belongs(path, OF_THE_USER) or any(word.startswith("_") for word in path.split(".")):
            return False
        if isinstance(leaf, str) and ("${" in leaf or (path == DOWNLOADED and not Path(leaf).expanduser().exists())):
            return False
        if not (leaf is None or isinstance(leaf, (str, int, float, bool))):
            return False
    return True


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, child in value.items():
            yield from _leaves(f"{path}.{key}", child)
    elif isinstance(value, list):
        for child in value:
            yield from _leaves(path, child)
    else:
        yield path, value


def _belongs(key: str, names: Sequence[str]) -> bool:
    return any(key == name or key.startswith((f"{name}.", f"{name}/", f"{name}@")) for name in names)
