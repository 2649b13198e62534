"""Quote paths for Hydra if they contain `=`, commas, spaces, brackets or non-ASCII letters.

A value is a path if it exists or if its setting is named like a path (`PATH_KEY`), unless it is written in Hydra's
syntax. In a sweep, commas in a path that does not exist separate several paths.
"""

import os
import re

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
