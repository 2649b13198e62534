"""Settings of structure from motion, the attempts in order, and the costs of its stages.

How many frames are taken from a video, `video_frames.py` decides.

`nerf poses` takes its settings from `conf/poses.yaml`, which repeats these defaults.
"""

from dataclasses import dataclass
from typing import Literal

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.data.sfm.image_pairs import Matching, image_pairs
from nerf_lightning.data.sfm.photograph_folder import FoundPhotograph
from nerf_lightning.messages.errors import require_positive

CameraMode = Literal["single", "per_image", "auto"]
Panoramas = bool | Literal["auto"]
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"]

FEATURES, MATCHING, MAPPING = "finding features", "comparing photographs", "placing cameras"
FEW, SOME = 24, 80
MAPPERS: tuple[Literal["incremental", "global"], ...] = ("incremental", "global")


@dataclass(frozen=True)
class SfmSettings:
    """Settings of structure from motion.

    Args:
        matching: which photographs are compared: all pairs, neighbors in the order of names, or chosen by their number.
        camera_mode: one camera for all, one each, or one per size and EXIF focal length.
        camera_model: COLMAP's name of the lens model; panoramas have one of their own.
        panoramas: whether the images are equirectangular panoramas; auto: if they say so, or if all are exactly twice
            as wide as high.
        num_features: maximum number of features per photograph; auto: 8192, or 2048 for more than 24 photographs, and
            further attempts if photographs are left out (`attempts`).
        max_image_size: longer side in pixels to which photographs are shrunk to find features.
        num_threads: None uses every core. Two runs are identical only with one thread.
        seed: of the random numbers.

    Raises:
        InputError: a count below 1.
    """

    matching: Matching = "auto"
    camera_mode: CameraMode = "auto"
    camera_model: CameraModel = "OPENCV"
    panoramas: Panoramas = "auto"
    num_features: int | Literal["auto"] = "auto"
    max_image_size: int = 2000
    num_threads: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        threads = 1 if self.num_threads is None else self.num_threads
        features = 1 if self.num_features == "auto" else self.num_features
        require_positive(num_features=features, max_image_size=self.max_image_size, num_threads=threads)

    @property
    def threads(self) -> int:
        """Return the number of threads to use."""
        return self.num_threads or num_cores()


@dataclass(frozen=True)
class Attempt:
    """One way to find cameras."""

    num_features: int
    affine: bool = True
    """Whether features have an affine shape, and so look similar from other viewpoints."""
    mapper: Literal["incremental", "global"] = "incremental"
    """One photograph after the other, or all at once."""

    @property
    def database(self) -> str:
        """The name of the file with its features and matches, which both mappers share."""
        return f"{self.num_features}{'_affine' if self.affine else ''}.db"

    def __str__(self) -> str:
        shape = "affine" if self.affine else "round"
        return "all cameras placed at once" if self.mapper == "global" else f"{self.num_features} {shape} features"


def attempts(settings: SfmSettings, count: int) -> list[Attempt]:
    """Return the attempts for `count` photographs, in order, until no photograph is left out.

    >>> [str(attempt) for attempt in attempts(SfmSettings(), 50)][:2]
    ['2048 round features', 'all cameras placed at once']
    """
    if settings.num_features != "auto":
        return [Attempt(settings.num_features)]
    if count <= FEW:
        features = [(8192, True), (8192, False)]
    elif count <= SOME:
        features = [(2048, False), (8192, True)]
    else:  # more would take hours
        features = [(2048, False)]
    return [Attempt(number, affine, mapper) for number, affine in features for mapper in MAPPERS]


def stage_costs(photographs: list[FoundPhotograph], settings: SfmSettings, attempt: Attempt) -> dict[str, float]:
    """Return roughly how many seconds each stage takes on one thread of an ordinary machine."""
    num_pairs = len(image_pairs(settings.matching, len(photographs)))
    shrunk = [(p, min(1.0, settings.max_image_size / max(p.width, p.height))) for p in photographs]
    megapixels = sum(p.width * p.height * scale**2 / 1e6 for p, scale in shrunk)
    return {
        FEATURES: 1.2 * megapixels,
        MATCHING: 0.02 * num_pairs * (attempt.num_features / 2048) ** 2,
        MAPPING: 0.4 * len(photographs),
    }
