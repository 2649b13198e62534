"""Render a view in slices: between two slices, the caller may do something else, or drop it."""

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

SLICE_SECONDS = 0.08  # Approximate time per slice: the user may change the request between two.
LEAST_HEIGHT = 32  # Minimum height of a picture (pixels).
FIRST_RAYS = 512
WARM_UP_HEIGHT = 64
FRESH = 0.4  # Weight of a new measurement of the speed.


@dataclass(frozen=True, eq=False)
class View:
    """A render and its camera."""

    rgb: Float[Tensor, "height width 3"]
    depth: Float[Tensor, "height width"]
    """Distance along the ray to where the light was absorbed (scene units); far if it was not."""
    opacity: Float[Tensor, "height width"]
    camera: Cameras


@dataclass(eq=False)
class SlicedRenderer:
    """Render camera states with a model, and measure the speed.

    Args:
        model: in evaluation mode while it renders.
        share: share of the time spent on rendering; 1 if there is nothing else to do.
        moving_seconds: maximum time for a picture while the camera moves.
        rays_per_second: the last measurement.
    """

    model: Model
    scene: SceneRecord
    background: Background
    tile_points: int
    share: float = 1.0
    moving_seconds: float = 0.1
    rays_per_second: float | None = None

    def height_while_moving(self, state: CameraState) -> int:
        """Return the height of a picture that allows several per second."""
        rays = (self.rays_per_second or FIRST_RAYS) * self.share * self.moving_seconds
        return max(LEAST_HEIGHT, int((rays * state.height / state.width) ** 0.5))

    def warm_up(self) -> None:
        """Render a small picture from the first photograph's position to load kernels and measure the speed."""
        state = CameraState(self.scene.cameras.c2w[0], 1.0, 4 * WARM_UP_HEIGHT // 3, WARM_UP_HEIGHT)
        for _ in range(2):
            for _ in self.slices(state, WARM_UP_HEIGHT):
                pass

    def slices(self, state: CameraState, height: int) -> Generator[None, None, View]:
        """Render a camera state at about this height (pixels); yield after each slice, and return the view."""
        cameras, near, far = camera_of(state, self.scene, height)
        shape = int(cameras.height[0]), int(cameras.width[0])
        rays_of, clip = RayGenerator(cameras, near, far), None if state.crop is None else Clip(box=state.crop)
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

    def _rays_in_a_slice(self, remaining: int) -> int:
        rays = QUAD * max(16, int((self.rays_per_second or FIRST_RAYS) * SLICE_SECONDS / QUAD))
        # No tiny remainder at the end: it would cost as much as a slice.
        return remaining if remaining < 1.5 * rays else rays
