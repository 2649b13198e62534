"""The overrides that a run or a sweep was started with, repeated if it is resumed by its folder's name.

The folder is untrusted: settings that the table in config/setting_rules.py does not let files set, and the choice of
loggers, are taken only from the command line.
"""

import logging
import re
import shlex
from collections.abc import Iterable, Iterator, Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, Literal

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException

from nerf_lightning.config.setting_rules import CHOSEN_GROUPS, PART, SWEEP_GROUPS, Trust, meaning_of
from nerf_lightning.files.regular import AbsentError
from nerf_lightning.files.yaml_files import read_plain_yaml
from nerf_lightning.messages.errors import InputError
from nerf_lightning.runs.sweep_record import read_sweep, sweep_record

# Limits that Hydra's parser, which takes quadratic time or more, handles in a second or two: total, per line, nesting.
MOST_CHARACTERS, LONGEST, DEEPEST = 1 << 13, 1 << 11, 8
OPTION = re.compile(r"[\w-]+(/[\w-]+)*", re.ASCII)
KEY = re.compile(r"[A-Za-z][\w-]*(\.[A-Za-z][\w-]*)*", re.ASCII)
OPTIONS = (*CHOSEN_GROUPS, "logger")
Fate = Literal["repeat", "leave out", "type again"]

parse = OverridesParser.create().parse_override
log = logging.getLogger(__name__)


def former_overrides(run_folder: Path, arguments: Sequence[str]) -> list[str]:
    """Return a run's original overrides, except those that belong to one start and those that the user gives again.

    Raises:
        InputError: the file is not a list of overrides, or contains one that is not repeated from files.
    """
    saved = run_folder / ".hydra" / "overrides.yaml"
    try:
        lines = read_plain_yaml(saved)
    except AbsentError:
        return []
    if not isinstance(lines, list) or not all(isinstance(line, str) for line in lines):
        raise InputError(f"{saved} is not a list of overrides: it is damaged. Give the run's settings by hand.")
    return list(_repeated(lines, arguments, saved, of_sweep=False))


def former_sweep(sweep_folder: Path, arguments: Sequence[str]) -> list[str]:
    """Return a sweep's original overrides; see `former_overrides`."""
    record = read_sweep(sweep_folder)
    return [] if record is None else list(_repeated(record.typed(), arguments, sweep_record(sweep_folder), True))


def to_give_again(overrides: Iterable[str], of_sweep: bool = False) -> list[str]:
    """Return, as typed in a shell, the overrides of a run or a sweep that are not repeated from its folder."""
    judged = ((line, *_judged(line, of_sweep)) for line in overrides)
    return [shlex.quote(line) for line, key, fate in judged if fate == "type again" or key == "logger"]


def _repeated(lines: Sequence[str], arguments: Sequence[str], saved: Path, of_sweep: bool) -> Iterator[str]:
    if sum(map(len, lines)) > MOST_CHARACTERS:
        raise InputError(f"{saved} holds more than {MOST_CHARACTERS:,} characters: give the settings by hand.")
    given = {argument.lstrip("+~").partition("=")[0] for argument in arguments}
    flag, kind = ("sweep.resume=true", "sweep") if of_sweep else ("resume=", "run")
    for line in lines:
        key, fate = _judged(line, of_sweep)
        if key in given or fate == "leave out":
            continue
        if fate == "type again":
            raise InputError(
                f"{saved} holds {line[:200]!r}, which is not taken from a file: settings that name a class, look "
                "something up, lead out of the capture, say where to write, what to fetch or what to trust, or are "
                f"infinite or unknown, must be typed. If this one is yours, type it again after {flag}; otherwise do "
                f"not resume this {kind}."
            )
        if key == "logger":
            log.warning("Loggers are not taken from %s: to log as before, type %s again.", saved, line)
        else:
            yield line


def _judged(line: str, of_sweep: bool) -> tuple[str, Fate]:
    """Return the key that an override sets, and what happens to it."""
    depth = max(accumulate((each in "[{(") - (each in "]})") for each in line), default=0)
    # Options of Hydra's own command line, such as --config-dir, are not overrides.
    if line.startswith("-") or len(line) > LONGEST or depth > DEEPEST:
        return "", "type again"
    try:
        override = parse(line)
        key = override.key_or_group
        # Jobs of a sweep that have not begun still start from its checkpoint.
        if meaning_of(key.replace("/", ".")).trust is Trust.ONE_START or (key == "init_from" and not of_sweep):
            return key, "leave out"
        return key, "repeat" if _is_harmless(override, of_sweep) else "type again"
    except HydraException:
        return "", "type again"


def _is_harmless(override: Override, of_sweep: bool) -> bool:
    key, package = override.key_or_group, override.package
    if key in SWEEP_GROUPS:
        value = override.value()
        return of_sweep and package is None and isinstance(value, str) and OPTION.fullmatch(value) is not None
    if not KEY.fullmatch(key) or (override.is_sweep_override() and not of_sweep):
        return False
    if package and not (key in OPTIONS and KEY.fullmatch(package) and meaning_of(package) is PART):
        return False
    values = [override.value()]
    if override.value_type in (ValueType.CHOICE_SWEEP, ValueType.SIMPLE_CHOICE_SWEEP):
        values = [parse(f"key={value}").value() for value in override.sweep_string_iterator()]
    elif override.is_sweep_override():  # sample values: a word for our own options, a number for a range
        values = ["any" if override.is_choice_sweep() else 0]
    return all(_is_taken(key, value) for value in values)


def _is_taken(key: str, value: Any) -> bool:
    if key in OPTIONS and not isinstance(value, dict):
        names = value if isinstance(value, list) else [value]
        return all(name is None or (isinstance(name, str) and OPTION.fullmatch(name)) for name in names)
    if isinstance(value, dict) and value:
        return all(_is_taken(f"{key}.{name}", child) for name, child in value.items())
    if isinstance(value, list) and value:
        return all(_is_taken(key, child) for child in value)
    return meaning_of(key).trust.takes(None if value in ([], {}) else value)
