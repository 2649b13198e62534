"""How far a run is: all that its random numbers depend on, beside the seed."""

from dataclasses import dataclass, fields

BATCH_SIZES = 8


def batch_sizes(largest: int) -> list[int]:
    """Return the sizes that batches may have, the largest first: it, its half, its quarter, ...

    >>> batch_sizes(4096)
    [4096, 2048, 1024, 512, 256, 128, 64, 32]
    """
    return [max(1, largest >> number) for number in range(BATCH_SIZES)]


def batch_size(largest: int, wanted: float, together: int = 1) -> int:
    """Return the largest of `batch_sizes` that is at most `wanted`, and a multiple of `together`, as `largest` is.

    >>> batch_size(4096, 1500.0), batch_size(4096, 1e9), batch_size(4096, 0.0), batch_size(4096, 0.0, together=256)
    (1024, 4096, 32, 256)
    """
    sizes = [size for size in batch_sizes(largest) if size % together == 0]
    return next((size for size in sizes if size <= wanted), sizes[-1])


@dataclass
class Progress:
    """How far a run is: all that its randomness and its order of rays depend on, besides the config."""

    attempt: int = 0
    """Raised by the collapse guard at each restart."""
    step: int = 0
    """Steps taken in this attempt."""
    rays_seen: int = 0
    """Rays trained on in this attempt, those of the center crop included."""
    batch_rays: int = 0
    """Rays of the next step; they may adapt to how many samples a ray has."""
    largest_batch: int = 0
    """Rays of a step at most."""
    rollbacks: int = 0
    """Attempts that went back to a checkpoint, instead of the beginning."""

    @property
    def restarts(self) -> int:
        """Attempts that began anew."""
        return self.attempt - self.rollbacks

    def advance(self, num_rays: int) -> None:
        """Count one step of `num_rays` rays."""
        self.step += 1
        self.rays_seen += num_rays

    def take_up(self, other: "Progress") -> None:
        """Go on from the place of another run."""
        for place in fields(self):
            setattr(self, place.name, getattr(other, place.name))

    def restart(self) -> None:
        """Begin a new attempt."""
        self.attempt, self.step, self.rays_seen = self.attempt + 1, 0, 0
