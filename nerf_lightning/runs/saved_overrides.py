"""The overrides that a run or a sweep was started with, repeated where it is gone on with by its folder's name.

They come out of a file in the folder, and the folder may come from anybody: what names a class, looks something
up (an interpolation), or is not trusted to files by the table in config/key_meanings.py is taken from the command line
alone.
"""

import re
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException

from nerf_lightning.config.key_meanings import CHOSEN_GROUPS, PART, SWEEP_GROUPS, Trust, is_removable, meaning_of
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.sweep_record import read_sweep, sweep_record

MOST_CHARACTERS = 1 << 16
OPTION = re.compile(r"[\w-]+(/[\w-]+)*", re.ASCII)
KEY = re.compile(r"[A-Za-z][\w-]*", re.ASCII)


def former_overrides(run_folder: Path, arguments: Sequence[str]) -> list[str]:
    """Return what a run was started with, but for what belongs to one start and what the user gives again."""
    saved = run_folder / ".hydra" / "overrides.yaml"
    if not saved.is_file():
        return []
    lines = read_plain_yaml(saved)
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError(f"{saved} is not a list of overrides: it is damaged. Give the run's settings by hand.")
    return list(_repeated(lines, arguments, saved, of_sweep=False))


def former_sweep(sweep_folder: Path, arguments: Sequence[str]) -> list[str]:
    """Return what a sweep was started with, but for what belongs to one start and what the user gives again.

    Raises:
        InputError: the file is no record of a sweep, or holds an override that is not repeated from files.
    """
    record = read_sweep(sweep_folder)
    if record is None:
        return []
    return list(_repeated(record.typed(), arguments, sweep_record(sweep_folder), of_sweep=True))


def to_give_again(overrides: Sequence[str], of_sweep: bool = False) -> list[str]:
    """Return, as typed in a shell, those overrides of a run or a sweep that are not repeated from its folder."""
    return [
        shlex.quote(line)
        for line, override in ((line, _parsed(line)) for line in overrides)
        if override and not _is_of_one_start(override, of_sweep) and not _is_harmless(override, of_sweep)
    ]


def _repeated(lines: Sequence[str], arguments: Sequence[str], saved: Path, of_sweep: bool) -> Iterator[str]:
    if sum(map(len, lines)) > MOST_CHARACTERS:
        raise InputError(f"{saved} holds more than {MOST_CHARACTERS:,} characters: give the settings by hand.")
    given = {argument.lstrip("+~").partition("=")[0] for argument in arguments}
    for line in lines:
        override = _parsed(line)
        if override is not None and (override.key_or_group in given or _is_of_one_start(override, of_sweep)):
            continue
        if override is None or not _is_harmless(override, of_sweep):
            flag, kind = ("sweep.resume=true", "sweep") if of_sweep else ("resume=", "run")
            raise InputError(
                f"{saved} holds {line[:200]!r}, which is not taken from a file: settings that name a class, look "
                "something up, say where to write, what to fetch or what to trust, or are unknown, must be typed. If "
                f"this one is yours, type it again after {flag}; otherwise do not resume this {kind}."
            )
        yield line


def _is_of_one_start(override: Override, of_sweep: bool) -> bool:
    return _trust(override.key_or_group, of_sweep) is Trust.ONE_START


def _trust(key_or_group: str, of_sweep: bool) -> Trust:
    meaning = meaning_of(key_or_group.replace("/", "."))
    return meaning.in_sweep if of_sweep and meaning.in_sweep is not None else meaning.trust


def _parsed(line: str) -> Override | None:
    try:
        # Options of Hydra's own command line, such as --config-dir, are none.
        return None if line.startswith("-") else OverridesParser.create().parse_override(line)
    except (HydraException, RecursionError, ValueError):  # brackets in brackets, a number of thousands of digits
        return None


def _is_harmless(override: Override, of_sweep: bool) -> bool:
    words = re.split("[./]", override.key_or_group)
    if not all(map(KEY.fullmatch, words)):
        return False
    if not of_sweep:
        return _is_harmless_alone(override, of_sweep)
    if words[0] == "hydra":
        return _is_sweep_setting(override)
    return all(job is not None and _is_harmless_alone(job, of_sweep) for job in _of_each_job(override))


def _is_sweep_setting(override: Override) -> bool:
    key, value = override.key_or_group, override.value()
    if override.package is not None or override.is_sweep_override():
        return False
    if key in SWEEP_GROUPS:
        return isinstance(value, str) and KEY.fullmatch(value) is not None
    return not isinstance(value, (dict, list)) and _is_plain(key, value, of_sweep=True)


def _of_each_job(override: Override) -> Iterator[Override | None]:
    key, kind = override.get_key_element(), override.value_type
    if kind in (ValueType.CHOICE_SWEEP, ValueType.SIMPLE_CHOICE_SWEEP):
        yield from (_parsed(f"{key}={value}") for value in override.sweep_string_iterator())
    elif kind == ValueType.GLOB_CHOICE_SWEEP:
        yield _parsed(f"{key}=any")  # stands for the names of our own options
    elif override.is_sweep_override():
        yield _parsed(f"{key}=0")  # stands for all numbers of a range or an interval
    else:
        yield override


def _is_harmless_alone(override: Override, of_sweep: bool) -> bool:
    if override.is_sweep_override():
        return False
    key, value, package = override.key_or_group, override.value(), override.package
    if package is not None and not (meaning_of(package) is PART and all(map(KEY.fullmatch, package.split(".")))):
        return False
    if key in CHOSEN_GROUPS:
        names = value if isinstance(value, list) else [value]
        are_options = all(name is None or (isinstance(name, str) and OPTION.fullmatch(name)) for name in names)
        return are_options or (isinstance(value, dict) and _is_plain(key, value, of_sweep))
    if "/" in key or package is not None:
        return False
    return is_removable(key) if override.is_delete() else _is_plain(key, value, of_sweep)


def _is_plain(key: str, value: Any, of_sweep: bool) -> bool:
    return all(_trust(path, of_sweep).takes(leaf) for path, leaf in _leaves(key, value))


def _leaves(path: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict) and value:
        for key, child in value.items():
            yield from _leaves(f"{path}.{key}", child)
    elif isinstance(value, list) and value:
        for child in value:
            yield from _leaves(path, child)
    else:
        yield path, value or None if isinstance(value, (dict, list)) else value  # of an empty one, its key alone counts
