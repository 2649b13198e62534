"""Other budgets for the length of a test."""

from collections.abc import Iterator
from contextlib import contextmanager

from nerf_lightning.files.budgets import Budgets, allow, allowed


@contextmanager
def budget(**limits: int) -> Iterator[None]:
    """Let other limits hold within the block."""
    before = allowed()
    allow(Budgets(**limits))
    try:
        yield
    finally:
        allow(before)
