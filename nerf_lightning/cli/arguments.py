"""Split a command line into Hydra's own options, parsed by Hydra, and settings; quote paths for Hydra.

Which setting takes a path without a key: PATH_SETTINGS in `config/help/catalogue.py`.
"""

import os
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

from nerf_lightning.config.help.catalogue import command_named, known_names
from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.suggestions import did_you_mean

PATH_KEY = re.compile(r"[+]*([\w.]+\.)?(root|images|video|checkpoint|ckpt|run|resume|init_from|\w+_(dir|file))")
OF_HYDRA = re.compile(r"""(['"]).*\1|\[.*\]|\{.*\}|.*(\$\{|\\[][(){}:=,\s]).*""")
"""Matches a quoted text, a list, a dictionary, an interpolation, an escaped character."""
SWEEP = re.compile(r""".*['"].*|(choice|glob|interval|range|shuffle|sort|tag)\(.*\)""")
"""Matches lists of values that are not separated by commas alone."""
QUOTED = re.compile(r"""(['"])((?:(?!\1)[^\\]|\\.)*)\1""")


def quoted_paths(arguments: list[str], sweep: bool) -> list[str]:
    """Return the arguments with quotes around the paths that Hydra would misread.

    >>> quoted_paths(["scene.root=my fox (1)", "seed=0"], sweep=False)
    ["scene.root='my fox (1)'", 'seed=0']
    >>> quoted_paths(["scene.root=fox,my fox", "paths.output_dir=out/a=1,b=2"], sweep=True)
    ["scene.root=fox,'my fox'", "paths.output_dir='out/a=1,b=2'"]
    """
    return [_quoted_path(word, sweep) for word in arguments]


def _quoted_path(word: str, sweep: bool) -> str:
    key, _, value = word.partition("=")
    if not value or word.startswith(("-", "~")) or os.path.exists(word):  # a path alone, such as 0_scene.root=fox
        return word
    named = PATH_KEY.fullmatch(key) is not None
    if os.path.exists(value):
        return f"{key}={_readable(value, named)}"
    if not named or OF_HYDRA.fullmatch(value):
        return word
    if not sweep or key.startswith("paths."):  # which belong to the sweep, not to a job
        return f"{key}={_readable(value, named)}"
    if SWEEP.fullmatch(value):
        return word
    return f"{key}={','.join(_readable(part.strip(), named) for part in value.split(','))}"


def _readable(path: str, is_text: bool) -> str:
    from nerf_lightning.config.overrides import PLAIN, quoted  # imports Hydra

    return path if PLAIN.fullmatch(path) and not (is_text and _is_number(path)) else quoted(path)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def unquoted(value: str) -> str:
    r"""Return a value without the quotes that enclose all of it.

    >>> unquoted("'it\\'s'"), unquoted("'a','b'"), unquoted("a,b")
    ("it's", "'a','b'", 'a,b')
    """
    text = QUOTED.fullmatch(value)
    return value if text is None else text[2].replace(f"\\{text[1]}", text[1])


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


def named_paths(arguments: list[str], key: str) -> list[str]:
    """Return the arguments with all paths gathered into `key=...`; `runs` takes several.

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

    if len(paths) > 1 and key != "runs":
        raise InputError(f"{key} takes one folder, but {len(paths)} were given: {', '.join(paths)}.")
    value = f"[{','.join(map(quoted, paths))}]" if key == "runs" else quoted(paths[0])
    return [*(word for word in arguments if word not in paths), f"{key}={value}"]
