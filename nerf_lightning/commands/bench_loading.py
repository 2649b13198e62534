"""`nerf bench`: how long a step waits for its batch."""

from collections.abc import Callable

from nerf_lightning.commands.timing import seconds_of
from nerf_lightning.data.ray_batches import RayBatches
from nerf_lightning.types.rays import Batch


class LoadedSteps:
    """Take steps whose batches come from the loader, as in training, and note how long each was waited for.

    Args:
        batches: the loader.
        train_on: takes one step.
        steps: how many at a time.
    """

    def __init__(self, batches: RayBatches, train_on: Callable[[Batch], None], steps: int):
        self.batches, self.train_on, self.steps = batches, train_on, steps
        self.stream = iter(batches)
        self.waits: list[float] = []
        """Seconds per step, one number for each call."""

    def __call__(self) -> None:
        """Take the steps."""
        waited = 0.0
        for _ in range(self.steps):
            waited += seconds_of(self._load)
            self.train_on(self.batch)
            self.batches.progress.advance(self.batches.progress.batch_rays)
        self.waits.append(waited / self.steps)

    def _load(self) -> None:
        self.batch = next(self.stream)
