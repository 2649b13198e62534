"""Baselines without a model: the nearest photograph, and a blend of the nearest ones, in place of a view.

A model of many scenes must be better. Both also exist with a plane: each ray intersects the plane through what the
cameras look at, perpendicular to the view's axis, and shows the color of that point in the photographs, as in light
field rendering (Levoy and Hanrahan, SIGGRAPH 1996). No depth is known or estimated. The photographs are those that the
models render from (`source_views.choose_sources`).
"""

from dataclasses import replace
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.extensions.view_transformer.projection import project_samples
from nerf_lightning.extensions.view_transformer.source_views import choose_sources, squared_distances
from nerf_lightning.extensions.view_transformer.view_tables import ViewTables
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.rendering.background import photograph
from nerf_lightning.nerf.types.scene import Background, Scene

SHARPNESS = 1e-3
"""Added to the squared distance of a photograph, in units of the nearest one's: its weight is the inverse."""
KINDS = ("nearest", "blend", "nearest_on_plane", "blend_on_plane")


class NearestViews:
    """The photographs of a scene, to be shown in place of its views.

    Args:
        scene: of one capture, or of several joined ones.
        background: the color behind transparent pixels.
        count: the number of photographs to blend.
    """

    def __init__(self, scene: Scene, background: Background, count: int):
        self.cameras, self.count = scene.cameras, count
        self.tables = ViewTables(replace(photographs_of(scene, scene.sources), background=background))
        self.rays_of = RayGenerator(
            scene.cameras, scene.near, scene.far, capture_of=scene.capture_of, names_photographs=True
        )

    def pictures(self, view: int) -> dict[str, Float[Tensor, "height width 3"]]:
        """Return the pictures shown in place of a view, for each of `KINDS`."""
        photographs, pixels = self.tables.photographs, all_pixels(self.cameras, view)
        shape, rays = pixels.x.shape, self.rays_of(pixels).map(lambda of_picture: of_picture.flatten(0, 1))
        capture = torch.zeros_like(rays.near, dtype=torch.int64) if rays.capture is None else rays.capture
        # A single source is the nearest; several are sorted from nearest to farthest.
        sources = choose_sources(photographs, rays, self.count, None)
        views = sources.views[sources.target]
        xy = torch.stack([pixels.x, pixels.y], dim=-1).flatten(0, 1) + 0.5
        as_is = self._colors(views, xy[:, None].expand(-1, views.shape[1], -1))
        axis = -self.cameras.c2w[view, :, 2]
        ahead = ((photographs.middle[capture] - rays.origins) * axis).sum(dim=-1)
        t = (ahead / (rays.directions * axis).sum(dim=-1).clamp(min=1e-6)).clamp(min=1e-6)
        seen = project_samples(photographs.cameras, self.tables.least_cosine, views, rays, t[:, None])
        on_plane, there = self._colors(views, seen.xy[:, 0]), seen.visible[:, 0]
        apart = squared_distances(photographs, capture, rays.origins, views)
        weights = 1.0 / (apart / apart.amin(dim=1, keepdim=True).clamp(min=1e-12) + SHARPNESS)
        weights, everywhere = weights * sources.valid[sources.target], torch.ones_like(there)
        found = [
            _mean(colors, kept)
            for colors, visible in ((as_is, everywhere), (on_plane, there))
            for kept in (functional.one_hot(visible.int().argmax(dim=1), visible.shape[1]) * visible, weights * visible)
        ]
        return {kind: picture.view(*shape, 3) for kind, picture in zip(KINDS, found, strict=True)}

    def _colors(self, views: Tensor, xy: Float[Tensor, "rays sources 2"]) -> Float[Tensor, "rays sources 3"]:
        used, numbered = torch.unique(views, return_inverse=True)
        return self.tables.colors(used, used.tolist()).look_up(numbered, xy)


def _mean(colors: Float[Tensor, "rays sources 3"], weights: Tensor) -> Float[Tensor, "rays 3"]:
    """Return the weighted mean of colors; white where all weights are 0."""
    total = weights.sum(dim=1, keepdim=True)
    return torch.where(total > 0, (weights[..., None] * colors).sum(dim=1) / total.clamp(min=1e-12), 1.0)


def baselines(scene: Scene, views: list[int], background: Background, count: int) -> dict[str, Any]:
    """Return the mean PSNR (dB) of each of `KINDS` on views of a scene, each shown by other photographs."""
    nearest = NearestViews(scene, background, count)
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for view in views:
        truth, kept = photograph(scene, view, background), scene.pixels.view_mask(view)
        for kind, picture in nearest.pictures(view).items():
            psnr = image_metrics(picture, truth, kept)["psnr"]
            assert psnr is not None
            found[kind].append(psnr)
    return {"photographs": count} | {kind: fmean(values) for kind, values in found.items()}
