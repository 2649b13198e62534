"""Where splats begin: on the surfaces that training views see in the field, flat, as large as neighbours leave room.

3DGS begins with the few points of structure from motion and makes more of them as it goes; a field knows a point, a
normal and a colour for every pixel.
"""

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from nerf_lightning.export.density_grid import Report
from nerf_lightning.export.visibility import see
from nerf_lightning.extensions.splats.gaussians import Gaussians, dc_of_color
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import at_most
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.rendering.blending import background_colors
from nerf_lightning.nerf.types.scene import SceneRecord

VIEWS, LONGEST = 40, 200  # Training views that are rendered, and their longer side in pixels.
LEAST_OPACITY = 0.5  # Pixels that stop less light see no surface.
OPACITY = 0.6
SPREAD = 0.4  # Standard deviation along the surface, in distances to the three nearest neighbours.
FLAT = 0.2  # And across it, as a share of that.
NEIGHBOURS = 3


def initial_gaussians(
    model: Model, record: SceneRecord, num_splats: int, sh_degree: int, tile_points: int, seed: int, report: Report
) -> Gaussians:
    """Return so many splats, or fewer where fewer pixels see a surface, at points of pixels drawn from all views.

    Far things have pixels like near ones, and so as many splats, large ones.

    Raises:
        InputError: no pixel sees a surface.
    """
    cameras, views = at_most(record.cameras, LONGEST), evenly_spaced_subset(record.splits["train"], VIEWS)
    behind = background_colors(record.background, 1, torch.device("cpu"), random=None)
    clouds, most = [], 0.0
    for number, view in enumerate(views):
        seen = see(model, record, cameras, view, tile_points)
        kept = (seen.opacity > LEAST_OPACITY) & seen.depth.isfinite() & seen.points.isfinite().all(dim=-1)
        opacity, most = seen.opacity[..., None], max(most, float(seen.opacity.max()))
        rgb = seen.rgb if behind is None else (seen.rgb - (1 - opacity) * behind) / opacity.clamp(min=LEAST_OPACITY)
        clouds.append(torch.cat([seen.points, seen.normals, rgb], dim=-1)[kept])
        report("surfaces", (number + 1) / len(views))
    cloud = torch.cat(clouds)
    if len(cloud) <= NEIGHBOURS:
        raise InputError(
            f"There is no surface to put splats on: the training views of {record.name} see opacities of at most "
            f"{most:.3g}, and {LEAST_OPACITY} is needed. Train longer."
        )
    generator = torch.Generator().manual_seed(seed)
    cloud = cloud[torch.randperm(len(cloud), generator=generator)[:num_splats]]
    points, normals, rgb = cloud.split(3, dim=-1)
    return _flat_gaussians(points, normals, rgb, sh_degree)


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
    """Return unit quaternions whose rotations take the z axis to the normals or their opposites; of zeros to itself.

    >>> towards(torch.tensor([[1.0, 0.0, 0.0]])).round(decimals=3).tolist()
    [[0.7070000171661377, 0.0, 0.7070000171661377, 0.0]]
    """
    x, y, z = (normals * torch.where(normals[:, 2:] < 0, -1.0, 1.0)).unbind(dim=-1)
    return torch.nn.functional.normalize(torch.stack([1 + z, -y, x, torch.zeros_like(z)], dim=-1), dim=-1)
