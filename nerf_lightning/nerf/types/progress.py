"""The progress of a run: all that its random numbers depend on, besides the seed."""

from dataclasses import dataclass, fields

SIZES_PER_HALVING, HALVINGS = 4, 7
"""Batch sizes per halving, and halvings. Each size has its own CUDA graph, and the wanted size is rounded down by 8 %
on average."""
WHOLE_BLOCKS = 256
"""Larger batches are multiples of this: Triton recompiles kernels for sizes that are not multiples of 16."""


def batch_sizes(largest: int, multiple_of: int = 1) -> list[int]:
    """Return the possible batch sizes, the largest first: each about 0.84 times the one before.

    Args:
        largest: the largest size.
        multiple_of: all sizes are multiples of this, `largest` included.

    >>> batch_sizes(4096)[:9], batch_sizes(4096)[-1]
    ([4096, 3328, 2816, 2304, 2048, 1536, 1280, 1024, 768], 32)
    """
    sizes = {largest}
    for number in range(1, SIZES_PER_HALVING * HALVINGS + 1):
        size = int(largest * 2.0 ** (-number / SIZES_PER_HALVING))
        size -= size % WHOLE_BLOCKS if size > WHOLE_BLOCKS else 0
        sizes.add(max(size - size % multiple_of, multiple_of))
    return sorted(sizes, reverse=True)


def batch_size(largest: int, wanted: float, multiple_of: int = 1) -> int:
    """Return the largest of `batch_sizes` that is at most `wanted`; the smallest if all are larger.

    >>> batch_size(4096, 1500.0), batch_size(4096, 1e9), batch_size(4096, 0.0), batch_size(4096, 0.0, multiple_of=256)
    (1280, 4096, 32, 256)
    """
    sizes = batch_sizes(largest, multiple_of)
    return next((size for size in sizes if size <= wanted), sizes[-1])


@dataclass
class Progress:
    """The progress of a run: all that its randomness and its order of rays depend on, besides the config."""

    attempt: int = 0
    """Raised by the collapse guard at each restart."""
    step: int = 0
    """Steps taken in this attempt."""
    rays_seen: int = 0
    """Rays trained on in this attempt, including those of the center crop."""
    batch_rays: int = 0
    """Rays of the next step, which may adapt to the number of samples per ray."""
    largest_batch: int = 0
    """Maximum number of rays per step."""
    rollbacks: int = 0
    """Attempts that went back to a checkpoint instead of the beginning."""

    @property
    def restarts(self) -> int:
        """Attempts that began from scratch."""
        return self.attempt - self.rollbacks

    def advance(self, num_rays: int) -> None:
        """Count one step of `num_rays` rays."""
        self.step += 1
        self.rays_seen += num_rays

    def take_up(self, other: "Progress") -> None:
        """Continue from the progress of another run."""
        for place in fields(self):
            setattr(self, place.name, getattr(other, place.name))

    def restart(self) -> None:
        """Begin a new attempt."""
        self.attempt, self.step, self.rays_seen = self.attempt + 1, 0, 0
