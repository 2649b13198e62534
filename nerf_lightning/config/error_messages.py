"""Errors as one paragraph: Hydra's and OmegaConf's, with near matches for a mistyped key; out of memory; a GPU's.

Values of the wrong type: `require_fitting` in `instantiate.py`.
"""

import os
import re
import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import extract_tb

from hydra.errors import HydraException, InstantiationException
from omegaconf import OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from nerf_lightning.config.help.catalogue import Command, command_named, known_names
from nerf_lightning.config.overrides import PLAIN, to_type
from nerf_lightning.config.setting_rules import LIGHTNING_ARGUMENTS
from nerf_lightning.files.folders import option_names
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed
from nerf_lightning.messages.suggestions import did_you_mean, near

ALL_OF = "nerf {0} --help lists the groups and their options, nerf {0} --cfg job the settings."
OF_OPTIONS = ("Only one of --run, --multirun", "The --resolve flag")
"""Prefixes of Hydra's complaints about its own options, which are plain ValueErrors."""
KEY = re.compile(r"Could not override '(?P<key>[^']+)'(?:.* use \+(?P=key)=(?P<value>.*))?")
ADDED = re.compile(r"(?:use 'override|remove \+ prefix:) '?(\S+?)(?:: |=)(.*?)'")
DELETED = re.compile(r"Could not delete(?: from config\.)? '(?P<key>[^']+)'(?P<value>)")
OPTION = re.compile(r"Could not find '([^']+)/([^'/]+)'")


@contextmanager
def in_words(command: str) -> Iterator[None]:
    """Turn every error caused by bad input into an InputError with one paragraph, whose hints name the command."""
    try:
        yield
    except Exception as error:
        message = None if isinstance(error, InputError) else paragraph(error, command)
        if message is None:
            raise
        raise InputError(message) from error


def paragraph(error: BaseException, command: str) -> str | None:
    """Return the message for an error caused by bad input, or None for any other error."""
    if isinstance(error, InputError):
        return str(error)
    if isinstance(error, (HydraException, OmegaConfBaseException)):
        return _missing_plugin(str(error)) or explain(error, command)
    if isinstance(error, ValueError) and str(error).startswith(OF_OPTIONS):
        return str(error)
    # Hydra does not check first whether a group's value is text.
    while_choosing = any(Path(frame.filename).name == "defaults_list.py" for frame in extract_tb(error.__traceback__))
    if isinstance(error, (ValueError, TypeError)) and while_choosing:
        return (
            f"A group was given something other than the name of one of its options: {error}. {ALL_OF.format(command)}"
        )
    if isinstance(error, (MemoryError, RuntimeError)):
        return _memory_or_gpu_failure(error)
    if isinstance(error, OSError):
        # Closing something because of bad input may fail for the same cause, and replace the original error.
        cause = next((link for link in _chain(error) if isinstance(link, InputError)), None)
        if cause is not None:
            return str(cause)
        where = f"{os.fsdecode(error.filename)}: " if error.filename else ""
        return f"{where}{error.strerror or error}. Check that the folder exists, is writable, and has free space."
    return None


def _memory_or_gpu_failure(error: MemoryError | RuntimeError) -> str | None:
    reason = " ".join(str(error).split())
    if not isinstance(error, MemoryError):
        # Imported late: it imports torch, which composing a config does not need and which may not fit into memory.
        from nerf_lightning.nerf.models.tiles import is_device_failure, is_out_of_memory
    if isinstance(error, MemoryError) or is_out_of_memory(error):
        return (
            f"Not enough memory: {reason.partition('. ')[0] or 'Python got none'}. Use a smaller model or smaller "
            "pictures, smaller tiles (trainer.tile_points), or another device (trainer=cpu); on a GPU, nvidia-smi "
            "shows what else is using it."
        )
    if is_device_failure(error):
        return (
            f"The GPU has failed: {reason[:200]}. Files written before are complete. Try again; if it fails again, "
            "nerf selftest checks the GPU's results, and trainer=cpu does not use it."
        )
    return None


def _missing_plugin(message: str) -> str | None:
    # Installed packages have registered their names with Hydra.
    unknown = re.search(r"'hydra/(launcher|sweeper)/(joblib|submitit|optuna)(_local|_slurm)?'", message)
    if unknown is None:
        return None
    kind, name = unknown.groups()[:2]
    extra = "slurm" if name == "submitit" else "sweep"
    return f"This {kind} needs {name}, which is not installed: pip install '.[{extra}]'."


def explain(error: BaseException, command: str) -> str:
    """Return what to tell the user about a bad override, an unknown name or a missing value."""
    chain = list(_chain(error))
    for link in chain:
        if isinstance(link, InputError):
            return str(link)
        if isinstance(link, MissingMandatoryValue):
            return _not_given(link, command)
    if isinstance(error, InstantiationException):
        where = re.search(r"full_key: (\S+)", str(error))
        reason = str(chain[-1]).splitlines()[0]
        part = where.group(1) if where else "The config"
        unknown = re.search(r"__init__\(\) got an unexpected keyword argument '(\w+)'", reason)
        if unknown is not None:
            key = f"{part}.{unknown[1]}"
            return (
                f"{key} is set, but the chosen {part} has no such setting. Leave it out; where an experiment sets it, "
                f"remove it with ~{key}."
            )
        if isinstance(chain[-1], ModuleNotFoundError):
            return (
                f"{part} cannot be built: {reason}. Python searches the installed packages and the folders in "
                f"PYTHONPATH. For a file of your own, put PYTHONPATH=FOLDER before nerf {command}."
            )
        return f"{part} cannot be built: {reason}. See nerf {command} --help."
    message = " ".join(str(error).split())
    unread = re.search(r"LexerNoViableAltException: ([^=\s]+)=(.*) \^ See https", message)
    unread = unread or re.search(r"Error parsing override '([^=\s]+)=(.*)' HydraException while evaluating", message)
    if unread:
        key, value = unread.groups()
        return (
            f"{key}={value} cannot be read: spaces, brackets and other special characters need quotes for Hydra and "
            f"for the shell. Type {to_type(key, value)}."
        )
    return unknown_name(message, command) or f"{message} {ALL_OF.format(command)}"


def _not_given(error: MissingMandatoryValue, command: str) -> str:
    key = error.full_key or str(error)
    if key not in ("ckpt", "run"):
        return f"nerf {command} needs {key}: add {key}=VALUE. nerf help {key} explains it."
    root = OmegaConf.select(error.parent_node._get_root(), "paths.root_dir") if error.parent_node else "outputs"
    last = max(Path(root).glob("**/checkpoints/last.ckpt"), key=lambda file: file.lstat().st_mtime, default=None)
    if last is None:
        return f"nerf {command} needs a run, and {root}/ holds none: train one, or name its folder with {key}=DIR."
    newest = shlex.quote(str(last.parent.parent))  # cli/arguments.py does the rest
    return f"nerf {command} needs a run. For the newest below {root}/, type: nerf {command} {key}={newest}"


def _chain(error: BaseException | None) -> list[BaseException]:
    links: list[BaseException] = []
    while error is not None and error not in links:  # an error that is raised again may be its own cause
        links.append(error)
        error = error.__cause__ or error.__context__
    return links


def unknown_name(message: str, command: str) -> str | None:
    """Return one line to replace Hydra's message to a command; None if it is about something else."""
    asked = command_named(command)
    if asked is None:
        return None
    option, key = OPTION.search(message), KEY.search(message) or DELETED.search(message)
    if option is not None:
        return _no_option(*option.groups())
    added = ADDED.search(message)
    if added is not None:
        return f"nerf {command} has {added[1]} already: leave out the +. Type {added[1]}={added[2]}."
    return None if key is None else _no_setting(key["key"], key["value"], asked)


def _no_option(group: str, name: str) -> str | None:
    options = option_names(group)
    if not options:  # not ours: from a folder in hydra.searchpath, or from a plugin
        return None
    cure = did_you_mean(name, options, f"{group}=") or f" Its options are {', '.join(options)}."
    return f"There is no {group}={name}.{cure} nerf help {group} lists them."


def _no_setting(name: str, value: str | None, command: Command) -> str:
    having = listed(dict.fromkeys(each.source for each in command.settings if each.key == name), cap=4)
    if having:
        instead = " scene=bricks is rendered, in the size scene.resolution=N." if name == "scene.downscale" else ""
        return f"{name} is a setting of {having}, which is not chosen.{instead} nerf help {name} explains it."
    told = f"nerf {command.name} has no setting {name}."
    section, _, argument = name.partition(".")
    if section == "trainer" and argument in LIGHTNING_ARGUMENTS:
        return f"{told} What Lightning's Trainer calls {argument} is {LIGHTNING_ARGUMENTS[argument]} here."
    training = command_named("train")
    if training is not None and name in known_names(training):
        own = f"nerf {command.name} --help lists what {command.name} has."
        return f"{told} It belongs to training: nerf help {name}. {own}"
    names = known_names(command)
    close = sorted(each for each in names if each.rpartition(".")[2] == name)[:3] or near(name, names)
    if close:
        given = f"={value}" if value and PLAIN.fullmatch(value) else ""
        return f"{told} Did you mean {' or '.join(f'{each}{given}' for each in close)}?"
    return f"{told} nerf {command.name} --help lists what it has; +{name}=VALUE adds one of your own."
