"""Paths that stand alone on the command line, turned into overrides."""

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
