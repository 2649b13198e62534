"""The one error that is meant for a person: bad input, said in one paragraph with its cure."""

from collections.abc import Iterable

ANOTHER = "The checkpoint is damaged, or made by somebody else: use another one."
"""The cure of a state that no run can have left."""


class InputError(Exception):
    """Report something that the user can mend.

    The command line prints the message as one paragraph and exits with code 2; no traceback. The message names
    what is wrong, where (file, key, value), and what to do about it.
    """


def require_positive(**counts: int) -> None:
    """Refuse intervals that never come.

    Raises:
        InputError: a count below 1.
    """
    for name, count in counts.items():
        if count < 1:
            raise InputError(f"{name}={count}: give 1 or more.")


def require_one_of(options: Iterable[str], **settings: object) -> None:
    """Refuse a setting that is none of the options.

    Raises:
        InputError: with all of them.
    """
    options = tuple(options)
    for name, value in settings.items():
        if value not in options:
            raise InputError(f"{name}={value}: choose one of {', '.join(options)}.")
