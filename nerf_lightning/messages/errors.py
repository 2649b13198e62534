"""The one error that is addressed to the user: bad input, explained in one paragraph with its cure.

Errors of Hydra, of full memory and of GPUs are put into words in `config/error_messages.py`.
Their line in the terminal: `_complain` in `cli/main.py`.
"""

from collections.abc import Iterable
from importlib import import_module
from typing import Any

ANOTHER = "The checkpoint is damaged, or was made by somebody else: use another one."
"""The cure for a state that no run can have written."""


class InputError(Exception):
    """A problem that the user can fix.

    The command line prints the message as one paragraph, without a traceback, and exits with code 2. The message names
    what is wrong, where (file, key, value), and what to do about it.
    """


def require_positive(**counts: int) -> None:
    """Refuse intervals that are not positive."""
    for name, count in counts.items():
        if count < 1:
            raise InputError(f"{name}={count}: give 1 or more.")


def require_extra(module: str, extra: str, asked_by: str) -> Any:
    """Return a module that one of this package's extras installs, or report how to install it."""
    try:
        return import_module(module)
    except (ImportError, RuntimeError) as error:  # torchvision built for another torch raises the latter
        package = module.partition(".")[0].replace("skimage", "scikit-image")
        raise InputError(
            f"{asked_by} needs {package}, which is not installed or does not load here ({error}). Install it with: "
            f"pip install '.[{extra}]'. Where that leaves it out, there is no wheel of {package} for this "
            "version of Python or this kind of computer yet."
        ) from error


def require_one_of(options: Iterable[str], **settings: object) -> None:
    """Refuse a setting that is not one of the options."""
    options = tuple(options)
    for name, value in settings.items():
        if value not in options:
            raise InputError(f"{name}={value}: choose one of {', '.join(options)}.")
