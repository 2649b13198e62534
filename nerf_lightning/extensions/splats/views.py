"""Pictures for fitting and evaluating splats: photographs or renders of the field, through pinholes."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.nn.functional import grid_sample, interpolate

from nerf_lightning.extensions.splats.gaussians import Pinhole
from nerf_lightning.nerf.geometry.cameras import all_pixels, at_most
from nerf_lightning.nerf.geometry.lenses import project_plane
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import Picture, render_picture
from nerf_lightning.nerf.rendering.background import background_colors, blend
from nerf_lightning.nerf.types.scene import Background, Cameras, Scene, SceneRecord
from nerf_lightning.visualization.pictures import straight_colors


@dataclass(frozen=True)
class View:
    """One picture with its camera."""

    camera: Pinhole
    rgba: UInt8[Tensor, "height width 4"]
    """Straight alpha."""
    mask: Bool[Tensor, "height width"] | None = None
    """Pixels that count; None: all."""

    def over(self, background: Float[Tensor, "3"]) -> Float[Tensor, "height width 3"]:
        """Return the picture over a background."""
        return blend(self.rgba / 255.0, background)


def color_behind(background: Background) -> Float[Tensor, "3"]:
    """Return the color behind splats; black if closed rays have nothing behind them."""
    shown = background_colors(background, 1, torch.device("cpu"), random=None)
    return torch.zeros(3) if shown is None else shown[0]


def without_lens(cameras: Cameras, longest: int) -> Cameras:
    """Return pinholes with the same focal lengths, for pictures whose longer side has at most `longest` pixels."""
    return replace(at_most(cameras, longest), lens=torch.zeros_like(cameras.lens), lens_model="pinhole")


def photographed(scene: Scene, view: int, pinholes: Cameras) -> View:
    """Return a photograph as taken by a pinhole: resampled if its lens distorts, or if it is larger.

    Viewers draw splats through pinholes. Pixels outside the photograph or its mask do not count.
    """
    rgba, kept = scene.pixels.view(view), scene.pixels.view_mask(view)
    camera = Pinhole.of(pinholes, view, float(scene.near[view]))
    height, width = camera.height, camera.width
    if scene.cameras.lens_model == "pinhole" and rgba.shape[:2] == (height, width):
        return View(camera, rgba, kept)
    flat = rgba.movedim(-1, 0)[None].float() / 255.0
    mask = torch.ones_like(flat[:, :1]) if kept is None else kept[None, None].float()
    planes = torch.cat([flat[:, :3] * flat[:, 3:], flat[:, 3:], mask], dim=1)  # premultiplied for averaging
    if rgba.shape[:2] != (height, width):
        planes = interpolate(planes, (height, width), mode="area")
    if scene.cameras.lens_model != "pinhole":
        planes = grid_sample(
            planes, _seen_through(scene.cameras, pinholes, view)[None], mode="bilinear", align_corners=False
        )
    premultiplied, alpha, mask = planes[0].movedim(0, -1).split([3, 1, 1], dim=-1)
    return View(camera, straight_colors(premultiplied, alpha[..., 0]), mask[..., 0] > 0.99)


def _seen_through(cameras: Cameras, pinholes: Cameras, view: int) -> Float[Tensor, "height width 2"]:
    """Return the places in the photograph, from -1 to 1, of what the pinhole's pixels see."""
    pixels = all_pixels(pinholes, view)
    plane = (torch.stack([pixels.x, pixels.y], dim=-1) + 0.5 - pinholes.center[view]) / pinholes.focal[view]
    bent = project_plane(
        torch.cat([plane, torch.ones_like(plane[..., :1])], -1), cameras.lens[view], cameras.lens_model
    )
    size = torch.stack([cameras.width[view], cameras.height[view]])
    return 2.0 * (bent * cameras.focal[view] + cameras.center[view]) / size - 1.0


def rendered(
    model: Model, record: SceneRecord, pinholes: Cameras, view: int, tile_points: int, background: Background
) -> Picture:
    """Render the field through a pinhole."""
    rays_of = RayGenerator(pinholes, record.near, record.far, names_photographs=model.needs_photographs)
    return render_picture(model, rays_of, view, background, tile_points)
