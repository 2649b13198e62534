"""Render the field around the photographs, and initialize flat splats on its surfaces.

3DGS begins with the few points of structure from motion and adds more during training; a field provides a point, a
normal and a color for every pixel. It is rendered from between the photographs and beyond, with a wider field of view:
splats would go wrong where few or no photographs see anything.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from nerf_lightning.export.base import Report
from nerf_lightning.export.visibility import SeenView, nearest_views, num_agreeing, see
from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole, dc_of_color
from nerf_lightning.extensions.splats.views import View, without_lens
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Cameras, SceneRecord
from nerf_lightning.visualization.pictures import straight_colors

COUNT, LONGEST = 60, 320  # Number of views of the field, and the longer side of each in pixels.
WIDER = 1.25  # Factor by which they are wider than the photographs,
WIDEST = 2.0  # and every other one if the scene has no box: windows are wider than photographs.
NEAREST = 4  # A position is between a view and one of this many nearest ones,
BEYOND = 0.5  # or beyond one of the two, by up to this share of the distance.
TOLERANCE = 0.03  # Share of the distance: a point is kept if one of the nearest views has its surface there.
OPACITY = 0.6
SPREAD = 0.4  # Standard deviation along the surface, in distances to the three nearest neighbors.
FLAT = 0.2  # Across it, as a share of that.
NEIGHBOURS = 3


@dataclass(frozen=True)
class Surroundings:
    """Renders of the field."""

    cameras: Cameras
    near: float
    renders: list[SeenView]

    def views(self) -> list[View]:
        """Return pictures to fit to, with the field's opacity as alpha."""
        cameras = [Pinhole.of(self.cameras, view, self.near) for view in range(len(self.renders))]
        return [View(camera, _rgba(seen)) for camera, seen in zip(cameras, self.renders, strict=True)]


def look_around(model: Model, record: SceneRecord, tile_points: int, seed: int, report: Report) -> Surroundings:
    """Render the field from positions around the training views."""
    pinholes, views = without_lens(record.cameras, LONGEST), list(record.splits["train"])
    wider = torch.tensor([WIDER, WIDER if record.space == "bounded" else WIDEST]).repeat(COUNT // 2)
    cameras = _interpolated_cameras(pinholes, views, torch.Generator().manual_seed(seed))
    cameras = replace(cameras, focal=cameras.focal / wider[:, None])
    near, far = (torch.full((COUNT,), float(each[views].mean())) for each in (record.near, record.far))
    around = replace(record, cameras=cameras, near=near, far=far, background="black")
    renders = []
    for view in range(COUNT):
        renders.append(see(model, around, cameras, view, tile_points))
        report("surfaces", (view + 1) / COUNT)
    return Surroundings(cameras, float(near[0]), renders)


def _interpolated_cameras(cameras: Cameras, views: Sequence[int], generator: torch.Generator) -> Cameras:
    # Axes are interpolated like centers, then projected to the nearest rotation by SVD.
    order = torch.randperm(max(COUNT, len(views)), generator=generator)[:COUNT].tolist()
    chosen, others = [views[k % len(views)] for k in order], []
    for view in chosen:
        near = nearest_views(cameras, view, views, NEAREST) or [view]
        others.append(near[int(torch.randint(len(near), (1,), generator=generator))])
    share = (1 + 2 * BEYOND) * torch.rand(COUNT, 1, 1, generator=generator) - BEYOND
    mixed = torch.lerp(cameras.c2w[chosen], cameras.c2w[others], share)
    left, _, right = torch.linalg.svd(mixed[:, :, :3])
    c2w = torch.cat([left @ right, mixed[:, :, 3:]], dim=-1)
    return replace(cameras[chosen], c2w=c2w)


def initial_gaussians(
    around: Surroundings, num_splats: int, sh_degree: int, seed: int, min_opacity: float
) -> Gaussians:
    """Return `num_splats` splats, or fewer if fewer pixels see a surface that a second view confirms.

    Distant objects cover pixels like near ones, and so get as many, but larger, splats.

    Raises:
        InputError: no pixel sees a surface.
    """
    numbers, clouds = list(range(len(around.renders))), []
    depths = {view: seen.surface_depth(min_opacity) for view, seen in enumerate(around.renders)}
    for view, seen in enumerate(around.renders):
        kept = depths[view].isfinite() & seen.points.isfinite().all(dim=-1)
        points, rgb = seen.points[kept], _rgba(seen)[kept][:, :3] / 255.0
        others = nearest_views(around.cameras, view, numbers, NEAREST)
        agreeing = num_agreeing(points, around.cameras, depths, others, TOLERANCE) > 0
        clouds.append(torch.cat([points, seen.normals[kept], rgb], dim=-1)[agreeing])
    cloud = torch.cat(clouds)
    if len(cloud) <= NEIGHBOURS:
        most = max(float(seen.opacity.max()) for seen in around.renders)
        raise InputError(
            f"There is no surface to put splats on: the field's opacity is at most {most:.3g} in {len(numbers)} views, "
            f"and min_opacity={min_opacity:g} is needed in two that agree. Train longer, or lower it."
        )
    cloud = cloud[torch.randperm(len(cloud), generator=torch.Generator().manual_seed(seed))[:num_splats]]
    points, normals, rgb = cloud.split(3, dim=-1)
    return _flat_gaussians(points, normals, rgb, sh_degree)


def _rgba(render: SeenView) -> Tensor:
    return straight_colors(render.rgb.minimum(render.opacity[..., None]), render.opacity)


def _flat_gaussians(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], rgb: Float[Tensor, "n 3"], sh_degree: int
) -> Gaussians:
    count = len(points)
    apart = cKDTree(points.numpy()).query(points.numpy(), NEIGHBOURS + 1, workers=-1)[0][:, 1:].mean(axis=1)
    width = torch.from_numpy(np.maximum(apart, 1e-6 * apart.max()).astype(np.float32))
    log_scales = (SPREAD * width).log()[:, None] + torch.tensor([1.0, 1.0, FLAT]).log()
    logits = torch.full((count,), OPACITY).logit()
    return Gaussians(
        points.contiguous(),
        log_scales,
        towards(normals),
        logits,
        dc_of_color(rgb.clamp(0, 1)),
        torch.zeros(count, (sh_degree + 1) ** 2 - 1, 3),
    )


def towards(normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Return unit quaternions that rotate the z axis to the normals or their opposites; the identity for zeros.

    >>> towards(torch.tensor([[1.0, 1.0, 0.0]])).tolist()
    [[0.5773502588272095, -0.5773502588272095, 0.5773502588272095, 0.0]]
    """
    x, y, z = (normals * torch.where(normals[:, 2:] < 0, -1.0, 1.0)).unbind(dim=-1)
    return torch.nn.functional.normalize(torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=-1), dim=-1)
