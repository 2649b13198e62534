"""What photographs give without a model: the nearest one, and a blend of the nearest ones, in the place of a view.

A model of many scenes has to be better than that. Both are also looked at through a plane: each ray meets the plane
through what the cameras look at, across the view's axis, and shows the colour of that point in the photographs, as
light fields are rendered (Levoy and Hanrahan, SIGGRAPH 1996). No depth is known or guessed. The photographs are those
that the models render from (`source_views.choose_sources`).
"""

from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from nerf_lightning.evaluation.metrics import image_metrics
from nerf_lightning.nerf.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.nerf.geometry.photographs import photographs_of
from nerf_lightning.nerf.models.view_transformer.projection import project_samples, seen_cosines
from nerf_lightning.nerf.models.view_transformer.source_views import choose_sources
from nerf_lightning.nerf.models.view_transformer.view_tables import ViewTables
from nerf_lightning.nerf.rendering.blending import photograph
from nerf_lightning.nerf.types.photographs import Photographs
from nerf_lightning.nerf.types.rays import RayBundle
from nerf_lightning.nerf.types.scene import Background, Scene

SHARPNESS = 1e-3
"""Added to the squared distance of a photograph, in units of the nearest one's: its weight is the inverse."""
KINDS = ("nearest", "blend", "nearest_on_plane", "blend_on_plane")


@dataclass(frozen=True)
class NearestViews:
    """The photographs of a scene, to be shown in the place of its views.

    Args:
        scene: one capture, or several that were joined.
        background: what lies behind transparent pixels.
        count: how many photographs are blended.
    """

    scene: Scene
    background: Background
    count: int

    def pictures(self, view: int) -> dict[str, Float[Tensor, "height width 3"]]:
        """Return what is shown in the place of a view, for each of `KINDS`."""
        scene = self.scene
        photographs = replace(photographs_of(scene, scene.sources), background=self.background)
        pixels = all_pixels(scene.cameras, view)
        rays = rays_through_pixels(scene.cameras, pixels, scene.near, scene.far)
        rays = replace(rays, photograph=pixels.view)
        if scene.capture_of is not None:
            rays = replace(rays, capture=torch.full_like(pixels.view, scene.capture_of[view]))
        shape, rays = pixels.x.shape, rays.map(lambda of_picture: of_picture.flatten(0, 1))
        # The nearest is the first of one; more come from nearest to farthest.
        sources = choose_sources(photographs, rays, self.count, None)
        places = sources.places[sources.target]
        at = torch.stack([pixels.x, pixels.y], dim=-1).flatten(0, 1) + 0.5
        as_is = self._colors(photographs, places, at[:, None].expand(-1, places.shape[1], -1))
        t = self._to_plane(photographs, rays, view)
        seen = project_samples(photographs.cameras, seen_cosines(photographs.cameras), places, rays, t[:, None])
        on_plane = self._colors(photographs, places, seen.at[:, 0])
        weights = self._weights(photographs, rays, places) * sources.given[sources.target]
        everywhere, there = torch.ones_like(seen.visible[:, 0]), seen.visible[:, 0]
        found = (
            _blended(as_is, weights, everywhere, first=True),
            _blended(as_is, weights, everywhere),
            _blended(on_plane, weights, there, first=True),
            _blended(on_plane, weights, there),
        )
        return {kind: picture.view(*shape, 3) for kind, picture in zip(KINDS, found, strict=True)}

    def _colors(
        self, photographs: Photographs, places: Tensor, at: Float[Tensor, "rays sources 2"]
    ) -> Float[Tensor, "rays sources 3"]:
        used, numbered = torch.unique(places, return_inverse=True)
        return ViewTables(photographs).colors(used.tolist(), at.device).look_up(numbered, at)

    def _to_plane(self, photographs: Photographs, rays: RayBundle, view: int) -> Float[Tensor, "rays"]:
        capture = 0 if self.scene.capture_of is None else self.scene.capture_of[view]
        axis = -self.scene.cameras.c2w[view, :, 2]
        ahead = ((photographs.middle[capture] - rays.origins) * axis).sum(dim=-1)
        cosine = (rays.directions * axis).sum(dim=-1).clamp(min=1e-6)
        return (ahead / cosine).clamp(min=1e-6)

    def _weights(self, photographs: Photographs, rays: RayBundle, places: Tensor) -> Float[Tensor, "rays sources"]:
        # By what photographs are chosen by: direction from the middle where cameras stand around it, else distance.
        capture, eyes = photographs.capture[places], photographs.cameras.c2w[places, :, 3]
        middle, around = photographs.middle[capture], photographs.around[capture]
        turned = functional.normalize(rays.origins[:, None] - middle, dim=-1) - functional.normalize(
            eyes - middle, dim=-1
        )
        apart = torch.where(around[..., None], turned, rays.origins[:, None] - eyes).square().sum(dim=-1)
        return 1.0 / (apart / apart.amin(dim=1, keepdim=True).clamp(min=1e-12) + SHARPNESS)


def _blended(
    colors: Float[Tensor, "rays sources 3"],
    weights: Float[Tensor, "rays sources"],
    visible: Tensor,
    first: bool = False,
) -> Float[Tensor, "rays 3"]:
    """Return the weighted mean of the colours that are visible, or the first of them; white where none is."""
    kept = weights * visible
    if first:
        kept = functional.one_hot(visible.int().argmax(dim=1), visible.shape[1]) * visible
    total = kept.sum(dim=1, keepdim=True)
    mean = (kept[..., None] * colors).sum(dim=1) / total.clamp(min=1e-12)
    return torch.where(total > 0, mean, 1.0)


def baselines(scene: Scene, views: list[int], background: Background, count: int) -> dict[str, Any]:
    """Return the mean PSNR (dB) of each of `KINDS` on some views.

    Args:
        scene: one capture, or several that were joined.
        views: of it, each shown by photographs that are not its own.
        background: what lies behind transparent pixels.
        count: how many photographs are blended.
    """
    nearest = NearestViews(scene, background, count)
    found: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for view in views:
        truth, kept = photograph(scene, view, background), scene.pixels.kept(view)
        for kind, picture in nearest.pictures(view).items():
            psnr = image_metrics(picture, truth, kept)["psnr"]
            assert psnr is not None
            found[kind].append(psnr)
    return {"photographs": count} | {kind: fmean(values) for kind, values in found.items()}
