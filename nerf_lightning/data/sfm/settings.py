"""Settings of structure from motion, which photographs are compared with each other, and what its stages cost."""

from dataclasses import dataclass
from itertools import combinations, groupby
from typing import Literal

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph
from nerf_lightning.messages.errors import require_positive

Matching = Literal["exhaustive", "sequential", "auto"]
CameraMode = Literal["single", "per_image", "auto"]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

FEATURES, MATCHING, MAPPING = "finding features", "comparing photographs", "placing cameras"
MOST_EXHAUSTIVE = 80
NEIGHBOURS = 10
LANDMARKS = 40
TILE = 12


@dataclass(frozen=True)
class SfmSettings:
    """How structure from motion is done.

    Args:
        matching: which photographs are compared: all pairs, neighbours in the order of names, or by their number.
        camera_mode: one camera for all, one each, or one per size and EXIF focal length.
        camera_model: COLMAP's name of the lens model.
        num_features: most features of a photograph.
        max_image_size: the longer side in pixels to which photographs are shrunk for finding features.
        num_threads: None uses every core. Two runs are identical only with one thread.
        seed: of the random numbers.

    Raises:
        InputError: a count below 1.
    """

    matching: Matching = "auto"
    camera_mode: CameraMode = "auto"
    camera_model: CameraModel = "OPENCV"
    num_features: int = 2048
    max_image_size: int = 2000
    num_threads: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        threads = 1 if self.num_threads is None else self.num_threads
        require_positive(num_features=self.num_features, max_image_size=self.max_image_size, num_threads=threads)

    @property
    def threads(self) -> int:
        """Return the number of threads to use."""
        return self.num_threads or num_cores()


def chosen_matching(matching: Matching, count: int) -> Matching:
    """Return how `count` photographs are compared: `auto` means all pairs while these are few (3160 for 80)."""
    if matching != "auto":
        return matching
    return "exhaustive" if count <= MOST_EXHAUSTIVE else "sequential"


def image_pairs(matching: Matching, count: int) -> list[tuple[int, int]]:
    """Return pairs (i, j), i < j, of photographs 0 to count - 1 in the order in which they were taken.

    Sequential: the ten that follow, those at a distance of a power of two, and all pairs among some forty spread over
    the whole, so that a path that comes back to where it was is closed. The number grows with count log count.

    >>> image_pairs("exhaustive", 3)
    [(0, 1), (0, 2), (1, 2)]
    >>> (0, 10) in image_pairs("sequential", 100), (0, 11) in image_pairs("sequential", 100)
    (True, False)
    """
    if chosen_matching(matching, count) == "exhaustive":
        return list(combinations(range(count), 2))
    steps = {*range(1, NEIGHBOURS + 1), *(2**power for power in range(count.bit_length()))}
    near = {(i, i + step) for i in range(count) for step in steps if i + step < count}
    landmarks = range(0, count, -(-count // LANDMARKS))
    return sorted(near | set(combinations(landmarks, 2)))


def tiles_of(pairs: list[tuple[int, int]]) -> list[list[tuple[int, int]]]:
    """Return the pairs in groups among few photographs: comparing a group loads and indexes each of these once."""

    def tile(pair: tuple[int, int]) -> tuple[int, int]:
        return pair[0] // TILE, pair[1] // TILE

    return [list(group) for _, group in groupby(sorted(pairs, key=tile), key=tile)]


def stage_costs(photographs: list[FoundPhotograph], settings: SfmSettings) -> dict[str, float]:
    """Return the seconds that each stage would take on one thread of an ordinary machine, roughly."""
    num_pairs = len(image_pairs(settings.matching, len(photographs)))
    shrunk = [(p, min(1.0, settings.max_image_size / max(p.width, p.height))) for p in photographs]
    megapixels = sum(p.width * p.height * scale**2 / 1e6 for p, scale in shrunk)
    return {
        FEATURES: 1.2 * megapixels,
        MATCHING: 0.04 * num_pairs * (settings.num_features / 2048) ** 2,
        MAPPING: 0.4 * len(photographs),
    }
