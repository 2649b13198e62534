"""All checks of a capture. A new check is one function in one file, named in that file's CHECKS."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from nerf_lightning.data.doctor import cameras, cost, extent, photographs, poses, views
from nerf_lightning.data.doctor.check import Check, CheckFn, Evidence
from nerf_lightning.data.doctor.evidence import gather
from nerf_lightning.types.scene import Scene

CHECKS: tuple[CheckFn, ...] = (
    *cameras.CHECKS,
    *poses.CHECKS,
    *extent.CHECKS,
    *views.CHECKS,
    *photographs.CHECKS,
    *cost.CHECKS,
)


def examine(scene: Scene) -> tuple[Evidence, list[Check]]:
    """Return the outcome of every check, and what they looked at; takes seconds."""
    with _one_thread_each():
        evidence = gather(scene)
        return evidence, [check(evidence) for check in CHECKS]


@contextmanager
def _one_thread_each() -> Iterator[None]:
    # Pictures are spread over our own threads; torch's would only stand in their way.
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
