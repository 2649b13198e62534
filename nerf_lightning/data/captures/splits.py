"""Split views into training views and held-out views: every Nth, by `hold_every` in conf/scene_defaults.yaml.

Which split stands in for a missing val or test: `CaptureReader._splits` in `reader.py`.
"""

import logging
from collections.abc import Callable, Hashable, Sequence
from typing import TypeVar

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.escaping import listed

MEMORISED = {"test_views": "learned from"}
"""The protocol of numbers that measure how well photographs are memorized, not new views."""

View = TypeVar("View", bound=Hashable)

log = logging.getLogger(__name__)


def in_order(views: Sequence[int], train_fraction: float) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the first views (the share `train_fraction`, rounded down) and the rest.

    >>> in_order(range(5), 0.8)
    ((0, 1, 2, 3), (4,))

    Raises:
        InputError: one of the two would be empty.
    """
    count = int(len(views) * train_fraction)
    return _both(tuple(views[:count]), tuple(views[count:]))


def every_kth(views: Sequence[int], k: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the training views and the held-out ones: the first and every `k`-th after it.

    >>> every_kth(range(5), 2)
    ((1, 3), (0, 2, 4))

    Raises:
        InputError: one of the two would be empty.
    """
    held = tuple(views[::k])
    out = set(held)
    return _both(tuple(view for view in views if view not in out), held)


def without_held_out(
    train: Sequence[View], val: Sequence[View], test: Sequence[View], named: Callable[[View], str], source: str
) -> tuple[View, ...]:
    """Return the training views without the held-out ones, and log which are left out.

    If a capture lists exactly the same views for training and test, that is intended; `checks.check_scene` warns about
    it. `named` returns a view's name, and `source` is the file that lists them.

    Raises:
        InputError: fewer than half of the training views would be left, so either list may be wrong.
    """
    held = {*val, *test}
    both = [view for view in train if view in held]
    if not both or set(train) == set(test):
        return tuple(train)
    names = listed(map(named, both), cap=5)
    left = len(train) - len(both)
    if left < len(both):
        raise InputError(
            f"{source}: {len(both)} of {len(train)} training views are also held out ({names}), and without "
            f"them {left} would be left. Remove them from the val and test lists to train on them, or from the "
            "training list."
        )
    log.warning(
        "%s: %d of %d views are listed both for training and as held out, and are not trained on: %s",
        source,
        len(both),
        len(train),
        names,
    )
    return tuple(view for view in train if view not in held)


def _both(train: tuple[int, ...], held: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Refuse an empty half."""
    if not train or not held:
        raise InputError(
            f"Holding out views from {len(train) + len(held)} leaves {len(train)} for training and {len(held)} for "
            "evaluation, but both need at least one. Add views, or hold out a different share."
        )
    return train, held
