"""Render a view in slices: between two of them its owner may do something else, or drop it."""

import time
from collections.abc import Generator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.extensions.viewer.camera_state import CameraState, camera_of
from nerf_lightning.nerf.geometry.clipping import Clip
from nerf_lightning.nerf.geometry.ndc import world_distance
from nerf_lightning.nerf.geometry.quads import QUAD, from_quads, pixels_in_quads, quads_between
from nerf_lightning.nerf.geometry.surfaces import surface_depth
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_rays, view_rays
from nerf_lightning.nerf.types.scene import Background, Cameras, SceneRecord

SLICE_SECONDS = 0.08  # How long a slice takes, about: a person may change the wish between two.
LEAST_HEIGHT = 32  # A picture is never smaller than this (pixels high).
FIRST_RAYS = 512
WARM_UP_HEIGHT = 64
FRESH = 0.4  # How much a new measurement of the speed counts.


@dataclass(frozen=True, eq=False)
class View:
    """What was rendered, and the camera that it was seen through."""

    rgb: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Distance along the ray to what stopped the light (scene units); where nothing did, far."""
    opacity: Float[Tensor, "height width"]
    camera: Cameras


@dataclass(eq=False)
class SlicedRenderer:
    """Render looks with a model, and learn how fast that goes.

    Args:
        model: in evaluation mode while it renders.
        share: of the time that goes by, so much is spent on rendering; 1 where there is nothing else to do.
        moving_seconds: how long a picture may take while the camera moves.
        rays_per_second: as it was measured last.
    """

    model: Model
    scene: SceneRecord
    background: Background
    tile_points: int
    share: float = 1.0
    moving_seconds: float = 0.1
    rays_per_second: float | None = None

    def height_while_moving(self, look: CameraState) -> int:
        """Return how high a picture can be so that several come in a second."""
        rays = (self.rays_per_second or FIRST_RAYS) * self.share * self.moving_seconds
        return max(LEAST_HEIGHT, int((rays * look.height / look.width) ** 0.5))

    def warm_up(self) -> None:
        """Render a small picture from the first photograph's place: kernels are loaded, the speed is known."""
        look = CameraState(self.scene.cameras.c2w[0], 1.0, 4 * WARM_UP_HEIGHT // 3, WARM_UP_HEIGHT)
        for _ in range(2):
            for _ in self.slices(look, WARM_UP_HEIGHT):
                pass

    def slices(self, look: CameraState, height: int) -> Generator[None, None, View]:
        """Render a look at about this height (pixels): yields after each slice, and returns the view."""
        cameras, near, far = camera_of(look, self.scene, height)
        shape = int(cameras.height[0]), int(cameras.width[0])
        rays_of, clip = RayGenerator(cameras, near, far), None if look.crop is None else Clip(box=look.crop)
        parts, start, total = [], 0, pixels_in_quads(*shape)
        while start < total:
            stop = start + self._rays_in_a_slice(total - start)
            began = time.perf_counter()
            parts.append(self._slice(rays_of, slice(start, stop), clip))
            measured = (stop - start) / max(time.perf_counter() - began, 1e-6)
            before = measured if self.rays_per_second is None else self.rays_per_second
            self.rays_per_second = (1 - FRESH) * before + FRESH * measured
            start = stop
            yield
        columns = (torch.cat(column) for column in zip(*parts, strict=True))
        rgb, depth, opacity = (from_quads(column, *shape) for column in columns)
        return View(rgb, depth, opacity, cameras)

    def _slice(self, rays_of: RayGenerator, part: slice, clip: Clip | None) -> tuple[Tensor, Tensor, Tensor]:
        rays, straight = view_rays(rays_of, quads_between(rays_of.cameras, 0, part), clip)
        seen = render_rays(self.model, replace(rays, together=QUAD), self.background, self.tile_points)
        far = rays.far.cpu()
        depth = surface_depth(seen.depth, seen.opacity, far)
        bent = rays_of.ndc is not None
        return seen.rgb, world_distance(straight.to("cpu"), depth / far) if bent else depth, seen.opacity

    def _rays_in_a_slice(self, left: int) -> int:
        rays = QUAD * max(16, int((self.rays_per_second or FIRST_RAYS) * SLICE_SECONDS / QUAD))
        # No crumb at the end: it would cost as much as a slice.
        return left if left < 1.5 * rays else rays
