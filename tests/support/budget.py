"""Other budgets for the length of a test."""

from collections.abc import Iterator
from contextlib import contextmanager

from nerf_lightning.files.budgets import Budgets, limits, set_limits


@contextmanager
def budget(**changed: int) -> Iterator[None]:
    """Let other limits hold within the block."""
    before = limits()
    set_limits(Budgets(**changed))
    try:
        yield
    finally:
        set_limits(before)
