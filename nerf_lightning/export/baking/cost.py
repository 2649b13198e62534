"""What baking costs: views marched through the bytes beside the model's own, against the photographs."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.export.baking.marcher import MarchedRays, Marcher
from nerf_lightning.export.density_grid import Report
from nerf_lightning.nerf.geometry.cameras import all_pixels
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import render_picture, view_rays
from nerf_lightning.nerf.psnr import picture_psnr
from nerf_lightning.nerf.rendering.blending import background_colors, photograph
from nerf_lightning.nerf.row_chunks import row_chunks
from nerf_lightning.nerf.types.scene import Background, Scene, SceneRecord


@dataclass(frozen=True)
class Cost:
    """Means over some views."""

    split: str
    num_views: int
    page_to_model: float | None = None
    """PSNR of the page's pictures, the model's taken for the truth (dB); None: no view was compared."""
    page: float | None = None
    """PSNR against the photographs (dB); None: there are none."""
    model: float | None = None
    num_densities: float = 0.0
    """Samples of density per pixel and frame, and those of color among them."""
    num_colors: float = 0.0

    def facts(self) -> list[tuple[str, str]]:
        """Return what a person may want to know, label and value."""
        if self.page_to_model is None:
            return []
        views = f"{self.num_views} {self.split} view{'s' if self.num_views > 1 else ''}"
        found = [("page, model", f"{self.page_to_model:.2f} dB between their pictures of {views}")]
        if self.page is not None and self.model is not None:
            cost = f"{self.page:.2f} dB against the photographs of {views}, the model {self.model:.2f} dB"
            found = [("PSNR", cost), *found]
        samples = f"{self.num_densities:.1f} of density and {self.num_colors:.1f} of color per pixel and frame"
        return [*found, ("samples", samples)]


def measured_cost(
    marcher: Marcher,
    model: Model,
    record: SceneRecord,
    photographs: Scene | None,
    max_views: int,
    tile_points: int,
    report: Report,
) -> Cost:
    """Render test views both ways; where there are none, those of validation or of training."""
    scene = record if photographs is None else photographs
    split = next(name for name in ("test", "val", "train") if scene.splits.get(name))
    views = evenly_spaced_subset(scene.splits[split], max_views) if max_views else []
    if not views:
        return Cost(split, 0)
    rays_of = RayGenerator(scene.cameras, scene.near, scene.far)
    errors: list[tuple[float, ...]] = []
    samples: list[tuple[float, float, float]] = []
    for number, view in enumerate(views):
        own = render_picture(model, rays_of, view, scene.background, tile_points).rgb.clamp(0, 1)
        page = torch.empty_like(own)
        for rows in row_chunks(*page.shape[:2]):
            marched = marcher.render(view_rays(rays_of, all_pixels(scene.cameras, view)[rows])[0])
            page[rows] = over(marched, scene.background).clamp(0, 1)
            samples.append((len(page[rows]) / len(page) / len(views), marched.num_densities, marched.num_colors))
        pairs: list[tuple[Tensor, Tensor, Tensor | None]] = [(page, own, None)]
        if photographs is not None:
            truth, kept = photograph(photographs, view, scene.background), photographs.pixels.kept(view)
            pairs += [(page, truth, kept), (own, truth, kept)]
        errors.append(tuple(picture_psnr(*pair) for pair in pairs))
        report("measured", (number + 1) / len(views))
    means = [float(column) for column in torch.tensor(errors, dtype=torch.float64).mean(dim=0)]
    share, *of_each = torch.tensor(samples).T
    densities, colors = ((share * each).sum().item() for each in of_each)
    of_page, of_model = means[1:] or (None, None)
    return Cost(split, len(views), means[0], of_page, of_model, densities, colors)


def over(marched: MarchedRays, background: Background) -> Float[Tensor, "*rays 3"]:
    """Return the colors over a background; where a scene has none, over black."""
    behind = background_colors(background, 1, torch.device("cpu"), random=None)
    return marched.rgb if behind is None else marched.rgb + (1.0 - marched.opacity)[..., None] * behind
