"""What the files of a COLMAP model hold, be they binary or text: cameras, and photographs with poses."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from jaxtyping import Float
from numpy import ndarray

MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}
"""COLMAP's numbers of camera models, with their names and counts of parameters."""
MOST_BYTES = 1 << 36
"""Of a file; ten million points with long tracks take a tenth."""
CURE = "Copy the model again, or run the reconstruction anew (nerf poses images=DIR)."
CURE_MODEL = "The file is damaged, or of a newer COLMAP: reconstruct with the camera model OPENCV, or undistort first."


@dataclass(frozen=True)
class ColmapCamera:
    """One camera's intrinsics."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ColmapImage:
    """One registered photograph."""

    name: str
    camera: int
    rotation: tuple[float, float, float, float]
    """World to camera, a quaternion w, x, y, z."""
    translation: tuple[float, float, float]


class ModelFiles(Protocol):
    """How the three files of one kind are parsed; each raises `InputError` with the place of a fault."""

    def cameras(self, path: Path) -> Iterator[tuple[int, ColmapCamera]]:
        """Return the cameras with their numbers."""

    def images(self, path: Path) -> Iterator[ColmapImage]:
        """Return the photographs."""

    def points(self, path: Path) -> Float[ndarray, "points 3"]:
        """Return the sparse points."""
