"""Settings of structure from motion, and what its stages cost."""

from dataclasses import dataclass
from typing import Literal

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.messages.errors import require_positive
from nerf_lightning.sfm.image_pairs import Matching, image_pairs
from nerf_lightning.sfm.photograph_folder import FoundPhotograph

CameraMode = Literal["single", "per_image", "auto"]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

FEATURES, MATCHING, MAPPING = "finding features", "comparing photographs", "placing cameras"


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
