"""How many samples rays have: counted in every step of training, averaged now and then, kept in checkpoints."""

from threading import Lock
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from nerf_lightning.messages.errors import ANOTHER, InputError
from nerf_lightning.nerf.part import Part

# So many samples per ray at most can have been counted.
MOST_SAMPLES = 1 << 12
# Threads may take tiles of one step side by side.
COUNTING = Lock()


class SampleCounter(Part):
    """Count samples on the device; `per_ray` is read on the host once after each average."""

    counts: Int[Tensor, "3"]
    """Samples and rays since the last average, and samples that exceeded the capacity, ever."""
    mean: Float[Tensor, ""]
    """Samples per ray before the last average; negative: unknown."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("counts", torch.zeros(3, dtype=torch.int64))
        self.register_buffer("mean", torch.tensor(-1.0))
        self._per_ray: float | None = None

    def add(self, samples: Int[Tensor, ""], rays: int, dropped: Int[Tensor, ""]) -> None:
        """Count samples of rays, and those for which there was no room."""
        counted = torch.stack([samples, torch.full_like(samples, rays), dropped])
        with COUNTING:
            self.counts += counted

    def average(self) -> None:
        """Take the mean over the rays since the last average."""
        if int(self.counts[1]):
            self.mean.copy_(self.counts[0] / self.counts[1])
            self.counts[:2] = 0
            self._per_ray = None

    @property
    def per_ray(self) -> float | None:
        """The mean number of samples of a ray; None where it is not known yet."""
        if self._per_ray is None:
            self._per_ray = float(self.mean)
        return self._per_ray if self._per_ray >= 0 else None

    def sample_counts(self) -> list[Tensor]:
        """Return samples and rays since the last average."""
        return [self.counts]

    def buffers_to_average(self) -> list[Tensor]:
        """Return the samples per ray; `per_ray` reads them again after this."""
        self._per_ray = None
        return [self.mean]

    def statistics(self) -> dict[str, float]:
        """Return samples per ray, and samples for which there was no room."""
        return {"speed/samples_per_ray": float(self.mean), "train/dropped_samples": float(self.counts[2])}

    def reset_statistics(self) -> None:
        """Forget all counts."""
        self.counts.zero_()
        self.mean.fill_(-1.0)
        self._per_ray = None

    def reset_parameters(self) -> None:
        """Forget all counts."""
        self.reset_statistics()

    def validate_state(self) -> None:
        """Check what was loaded.

        Raises:
            InputError: negative counts, or a mean that cannot be.
        """
        if bool((self.counts < 0).any()) or not -1.0 <= float(self.mean) <= MOST_SAMPLES:
            raise InputError(f"The samples per ray in the model's state are not valid counts. {ANOTHER}")

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self._per_ray = None


def average_counts(module: nn.Module) -> None:
    """Let every counter within a module take the mean over the rays since its last average."""
    for part in module.modules():
        if isinstance(part, SampleCounter):
            part.average()
