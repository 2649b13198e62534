"""Split a command line into Hydra's own options, parsed by Hydra, and settings; turn paths into overrides."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

from nerf_lightning.config.help.catalogue import command_named, known_names
from nerf_lightning.config.help.suggestions import did_you_mean
from nerf_lightning.messages.errors import InputError

COMMON = ("--help", "--version", "--verbose", "--multirun", "--cfg", "--resolve", "--config-dir", "--hydra-help")


def options_first(arguments: Sequence[str], command: str = "train") -> list[str]:
    """Return Hydra's options, each as one word, followed by the overrides, in whatever order they were typed.

    Raises:
        InputError: an option is unknown, or has no value or a wrong one.

    >>> options_first(["seed=1", "--cfg", "job", "model=nerf", "-m"])
    ['--cfg=job', '--multirun', 'seed=1', 'model=nerf']
    """
    from nerf_lightning.config.hydra_versions import options_parser  # imported late: `--help` needs no Hydra

    parser = options_parser()
    parser.error = lambda message: _refuse(message, arguments, command)  # type: ignore[method-assign]
    unasked = vars(parser.parse_args([]))
    asked = vars(parser.parse_intermixed_args(arguments))
    overrides: list[str] = asked.pop("overrides")
    given = {f"--{name.replace('_', '-')}": value for name, value in asked.items() if value != unasked[name]}
    return [*(name if value is True else f"{name}={value}" for name, value in given.items()), *overrides]


def _refuse(message: str, arguments: Sequence[str], command: str) -> NoReturn:
    option = next((word for word in message.split() if word.startswith("--")), "")
    name, _, value = option.removeprefix("--").replace("-", "_").partition("=")
    asked = command_named(command)
    known = [key for key in known_names(asked) if not key.startswith("hydra")] if asked and name else []
    keys = [key for key in known if key.rpartition(".")[2] == name]
    if keys:
        value = value or next((word for before, word in pairwise(arguments) if before == option), "VALUE")
        hint = " or ".join(f"{key}={value}" for key in keys[:3])
        raise InputError(f"{option}: settings are given without dashes, as key=value. Type {hint}.")
    hint = did_you_mean(option, COMMON) or f" nerf help {name.replace('_', ' ')} looks for a setting." * bool(name)
    raise InputError(f"{message}.{hint} nerf COMMAND --hydra-help lists the options; settings are given as key=value.")


def require_settings(words: Sequence[str], or_paths: bool) -> None:
    """Refuse words that are not settings, such as spaces around `=` leave; `or_paths`: one without `=` is a path."""
    bare = ["=" not in word and not word.startswith(("-", "~")) for word in words]
    for word, is_bare, before_bare in zip(words, bare, [*bare, False][1:], strict=True):
        if word.startswith("=") or (is_bare and not or_paths) or (word.endswith("=") and before_bare):
            raise InputError(
                f"'{word}' is not a setting. Settings are key=value without spaces, such as scene.root=data/x. "
                'A value that has spaces needs quotes for the shell: "scene.root=data/my x".'
            )


def named_paths(arguments: list[str], key: str, several: bool) -> list[str]:
    """Return the arguments with all paths gathered into `key=...`.

    An argument is a path if it has no `=` or if it exists: the folders of a sweep's jobs are named `0_seed=0`. So is
    `ckpt=PATH`, which other commands take.
    """
    arguments = arguments if key == "ckpt" else [word.removeprefix("ckpt=") for word in arguments]
    paths = [
        word for word in arguments if not word.startswith(("-", "+", "~")) and ("=" not in word or Path(word).exists())
    ]
    if not paths:
        return arguments
    from nerf_lightning.config.overrides import quoted  # imports Hydra

    if len(paths) > 1 and not several:
        raise InputError(f"{key} takes one folder, but {len(paths)} were given: {', '.join(paths)}.")
    value = f"[{','.join(map(quoted, paths))}]" if several else quoted(paths[0])
    return [*(word for word in arguments if word not in paths), f"{key}={value}"]
