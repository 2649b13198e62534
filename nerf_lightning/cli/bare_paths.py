"""Paths on the command line: those that stand alone become overrides, those with a `=` in them are quoted."""

from pathlib import Path

from nerf_lightning.errors import InputError


def named_paths(arguments: list[str], key: str, several: bool) -> list[str]:
    """Return the arguments with those that are paths gathered into `key=...`.

    A path is what has no `=`, or what is there: the folders of a sweep's jobs are named `0_seed=0`.

    Raises:
        InputError: there are several where one is wanted.
    """
    paths = [word for word in arguments if not word.startswith(("-", "+", "~")) and _is_path(word)]
    if not paths:
        return arguments
    from nerf_lightning.config.overrides import quoted

    if len(paths) > 1 and not several:
        raise InputError(f"{key}: one folder is wanted, and {len(paths)} were given: {', '.join(paths)}.")
    value = f"[{','.join(map(quoted, paths))}]" if several else quoted(paths[0])
    return [*(word for word in arguments if word not in paths), f"{key}={value}"]


def _is_path(word: str) -> bool:
    return "=" not in word or Path(word).exists()


def quoted_paths(arguments: list[str]) -> list[str]:
    """Return the arguments, the values quoted that are paths with a `=` in them, which Hydra would not read.

    The folders of a sweep's jobs have one: `ckpt=outputs/sweeps/SWEEP/0_seed=0`.
    """
    return [_with_quotes(word) if word.count("=") > 1 and not word.startswith("-") else word for word in arguments]


def _with_quotes(word: str) -> str:
    from nerf_lightning.config.overrides import quoted

    key, _, value = word.partition("=")
    return f"{key}={quoted(value)}" if "=" in value and Path(value).exists() else word
