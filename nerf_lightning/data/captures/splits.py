"""Which views are learnt from and which are held out."""

from collections.abc import Sequence

from nerf_lightning.errors import InputError


def in_order(views: Sequence[int], train_fraction: float) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the first views, the share `train_fraction` of them rounded down, and the rest.

    >>> in_order(range(5), 0.8)
    ((0, 1, 2, 3), (4,))

    Raises:
        InputError: one of the two would be empty.
    """
    count = int(len(views) * train_fraction)
    return _both(tuple(views[:count]), tuple(views[count:]))


def every_kth(views: Sequence[int], k: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the views that stay and those that are held out: the first and every `k`-th after it.

    >>> every_kth(range(5), 2)
    ((1, 3), (0, 2, 4))

    Raises:
        InputError: one of the two would be empty.
    """
    held = tuple(views[::k])
    return _both(tuple(view for view in views if view not in set(held)), held)


def _both(train: tuple[int, ...], held: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Refuse an empty half."""
    if not train or not held:
        raise InputError(
            f"Holding out views from {len(train) + len(held)} leaves {len(train)} to learn from and "
            f"{len(held)} to judge by, but each needs at least one. Add views, or hold out "
            "another share of them."
        )
    return train, held
