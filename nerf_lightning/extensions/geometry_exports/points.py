"""A colored point cloud with normals, from the rendered depth of the training views, as binary PLY or LAS."""

import logging
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from nerf_lightning.compute.machine import require_memory
from nerf_lightning.export.base import MODEL_ALONE, Export, RunContext, require_free, require_setting
from nerf_lightning.export.visibility import nearest_views, num_agreeing, see
from nerf_lightning.extensions.geometry_exports.mesh_files import require_library
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.console import StageProgress
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import at_most
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, points_to_user
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord
from nerf_lightning.visualization.pictures import to_bytes

# For all views' points until they are confirmed, each view's picture, and a copy as one cloud.
BYTES_PER_PIXEL = 90
# For the points that are written: in the user's frame, in double precision, and as rows of the file.
BYTES_PER_POINT = 150
NEIGHBOURS = 8  # Number of the nearest other views that are checked for agreement.
PointFormat = Literal["ply", "las"]
COSTS = {"depth": 10.0, "agreement": 1.0}

log = logging.getLogger(__name__)


@dataclass
class PointsExport(Export):
    """Write `points.ply` or `points.las`: a point per pixel of the training views.

    Points that other views do not confirm are left out.

    Args:
        num_points: maximum number of points, which are drawn at random if there are more.
        max_views: maximum number of training views to render.
        longest: maximum length of the longer side of renders, in pixels.
        agreement: how many of the 8 nearest views must see the same surface.
        tolerance: maximum relative difference of their depths.
        format: the file format: PLY, with normals, or LAS (1.2, point format 2) for survey software, without
            normals, which needs `pip install '.[las]'`.
    """

    crops = True

    num_points: int = 1_000_000
    max_views: int = 100
    longest: int = 400
    agreement: int = 2
    tolerance: float = 0.01
    format: PointFormat = "ply"

    def __post_init__(self) -> None:
        for name, least in {"num_points": 1, "max_views": 1, "longest": 2, "agreement": 0}.items():
            value = getattr(self, name)
            require_setting(name, value, value >= least, f"give {least} or more.")
        asked = f"{NEIGHBOURS} other views are compared, so give at most that number."
        require_setting("agreement", self.agreement, self.agreement <= NEIGHBOURS, asked)
        require_setting("tolerance", self.tolerance, self.tolerance > 0, "give a share of the distance, above 0.")

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the cloud."""
        require_free(files=[child_of(folder, f"points.{self.format}")])
        if self.format == "las":
            require_library("laspy", "las")  # before the work, not after it
        views = evenly_spaced_subset(record.splits["train"], self.max_views)
        self._require_memory(record.cameras[views])
        cameras = at_most(record.cameras, self.longest)
        clouds: dict[int, Tensor] = {}
        depths: dict[int, Tensor] = {}
        opacities, candidates = [], 0
        with StageProgress(COSTS) as report:
            for number, view in enumerate(views):
                seen = see(model, record, cameras, view, tile_points)
                depths[view] = seen.surface_depth(run.min_opacity)
                opaque = depths[view].isfinite()
                kept = opaque & (seen.normals.norm(dim=-1) > 0.5)
                clouds[view] = torch.cat([seen.points[kept], seen.normals[kept], seen.rgb[kept]], dim=-1)
                candidates += int(opaque.sum())
                opacities += [float(seen.opacity.min()), float(seen.opacity.max())]
                report("depth", (number + 1) / len(views))
            least = min(self.agreement, len(views) - 1)
            for number, view in enumerate(views):
                others = nearest_views(cameras, view, views, NEIGHBOURS)
                count = num_agreeing(clouds[view][:, :3], cameras, depths, others, self.tolerance)
                clouds[view] = clouds[view][count >= least]
                report("agreement", (number + 1) / len(views))
        del depths
        cloud = torch.cat(list(clouds.values()))
        del clouds
        if not len(cloud):
            raise InputError(self._nothing(record, min(opacities), max(opacities), candidates, run.min_opacity))
        log.info("%d of %d points are confirmed by other views", len(cloud), candidates)
        if run.crop is not None:
            cloud = cloud[run.crop.holds(cloud[:, :3])]
            if not len(cloud):
                raise InputError("crop: there are no points in this box. Its corners are in the capture's own frame.")
        return [self._save(cloud, record, folder)]

    def _save(self, cloud: Float[Tensor, "points 9"], record: SceneRecord, folder: Path) -> Path:
        if len(cloud) > self.num_points:
            cloud = cloud[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(0))[: self.num_points]]
        to_user, path = record.to_user.double(), child_of(folder, f"points.{self.format}")
        points = points_to_user(cloud[:, :3].double(), to_user)
        colors = to_bytes(cloud[:, 6:]).numpy()
        if self.format == "las":
            save_las(path, points.numpy(), colors)
        else:
            normals = directions_to_user(cloud[:, 3:6].double(), to_user)
            save_points(path, points.numpy(), normals.numpy(), colors)
        return path

    def _require_memory(self, cameras: Cameras) -> None:
        """Refuse more pixels than fit into memory if they were all opaque and confirmed."""

        def num_pixels(longest: int) -> int:
            small = at_most(cameras, longest)
            return int((small.width * small.height).sum())

        def needed(longest: int) -> int:
            pixels = num_pixels(longest)
            return BYTES_PER_PIXEL * pixels + BYTES_PER_POINT * min(pixels, self.num_points)

        require_memory(
            f"what.longest={self.longest} makes {num_pixels(self.longest):,} points of {len(cameras.width)} views",
            min(self.longest, int(torch.maximum(cameras.width, cameras.height).max())),
            needed,
            lambda longest: f"what.longest={longest} (or a smaller what.max_views)",
        )

    def _nothing(self, record: SceneRecord, lowest: float, highest: float, candidates: int, min_opacity: float) -> str:
        if candidates:
            return (
                f"{candidates} pixels of {record.name} are opaque, but no point is confirmed by {self.agreement} other "
                "views. Train longer, or give a smaller what.agreement or a larger what.tolerance."
            )
        return (
            f"There is no surface to export: the opacities of {record.name}'s training views go from {lowest:.3g} to "
            f"{highest:.3g}, and min_opacity={min_opacity:g}. Train longer, or lower it."
        )


NUMBERS, COLORS = ("x", "y", "z", "nx", "ny", "nz"), ("red", "green", "blue")
LAYOUT = np.dtype([*((name, "<f4") for name in NUMBERS), *((name, "u1") for name in COLORS)])


def save_points(
    path: Path,
    points: Float[ndarray, "points 3"],
    normals: Float[ndarray, "points 3"],
    colors: UInt8[ndarray, "points 3"],
) -> None:
    """Write a point cloud atomically."""
    rows = np.empty(len(points), LAYOUT)
    for name, column in zip((*NUMBERS, *COLORS), (*points.T, *normals.T, *colors.T), strict=True):
        rows[name] = column
    header = [
        *("ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"),
        *(f"property float {name}" for name in NUMBERS),
        *(f"property uchar {name}" for name in COLORS),
        "end_header",
    ]
    with whole_file(path) as part:
        part.write_bytes(("\n".join(header) + "\n").encode() + rows.tobytes())


MOST_STEPS = 1e9  # LAS stores positions as 32-bit integers; the extent takes from a tenth of this to all of it.
FINEST = 1e-30  # For a cloud of a single position at zero.
COLOR_SCALE = 257  # Colors have 16 bits there, full scale: 255 becomes 65535.


def save_las(path: Path, points: Float[ndarray, "points 3"], colors: UInt8[ndarray, "points 3"]) -> None:
    """Write a point cloud as LAS 1.2 (point format 2: positions and sRGB colors, no normals) atomically."""
    laspy = require_library("laspy", "las")
    header = laspy.LasHeader(version="1.2", point_format=2)
    header.generating_software = "nerf-lightning"
    header.scales, header.offsets = scale_and_offset(points)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = COLOR_SCALE * colors.T.astype(np.uint16)
    with whole_file(path) as part, part.open("wb") as file:
        las.write(file, do_compress=False)


def scale_and_offset(points: Float[ndarray, "points 3"]) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """Return the step of the integers, the same for all axes, and their offset.

    The step is the finest power of ten of which the extent takes at most 1e9, but no finer than the resolution of
    double precision at this distance from zero. The offset is a multiple of the step, at or below the minimum
    coordinates.

    >>> scale, offset = scale_and_offset(np.array([[-3.0, 0.0, 1.0], [5.0, 2.0, 1.5]]))
    >>> scale.tolist(), offset.tolist()
    ([1e-08, 1e-08, 1e-08], [-3.0, 0.0, 1.0])
    """
    lowest = points.min(axis=0)
    extent, finest = float((points.max(axis=0) - lowest).max()), float(np.spacing(np.abs(points).max()))
    step = 10.0 ** math.ceil(math.log10(max(extent / MOST_STEPS, finest, FINEST)))
    return np.full(3, step), step * np.floor(lowest / step)
