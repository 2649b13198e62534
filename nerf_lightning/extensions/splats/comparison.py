"""Compare splats and field on held-out views with the photographs, or, without these, with each other."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from nerf_lightning.evaluation.metrics import image_metrics, mean_over_images
from nerf_lightning.export.base import Report
from nerf_lightning.extensions.splats.fitted import FittedSplats
from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole
from nerf_lightning.extensions.splats.rasterizer import rasterize
from nerf_lightning.extensions.splats.views import color_behind, photographed, rendered
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Background, Scene


@dataclass(frozen=True)
class Comparison:
    """Mean metrics over some views."""

    views: str
    """Number of views and their split."""
    splats: dict[str, Any]
    field: dict[str, Any] | None
    """None: there are no photographs, and the field's renders are the truth for the splats."""
    panels: list[tuple[str, Tensor]]
    """Pictures of the first view, by name."""

    def facts(self) -> list[tuple[str, str]]:
        """Return the metrics of splats and field in one row each, with its label."""
        rows = [("quality", self.splats, f" on {self.views} without lens distortion")]
        if self.field is not None:
            rows.append(("the model's, for comparison", self.field, "; its report keeps the distortion"))
        return [(label, f"PSNR {row['psnr']:.2f} dB{_ssim(row)}{how}") for label, row, how in rows]

    def psnr(self) -> str:
        """Return a summary for the user."""
        said = f"{self.splats['psnr']:.2f} dB on {self.views}"
        if self.field is None:
            return f"{said}, with the field's renders as the truth"
        said += f"; the model, compared in the same way (without lens distortion): {self.field['psnr']:.2f} dB"
        ssim = "" if self.field["ssim"] is None else f"; SSIM {self.splats['ssim']:.3f} and {self.field['ssim']:.3f}"
        return said + ssim


def _ssim(metrics: dict[str, Any]) -> str:
    return "" if metrics["ssim"] is None else f", SSIM {metrics['ssim']:.3f}"


def compared(
    fitted: FittedSplats,
    gaussians: Gaussians,
    model: Model,
    background: Background,
    max_views: int,
    tile_points: int,
    report: Report,
) -> Comparison:
    """Render held-out views, or else training views, with `gaussians`, which may be rounded, and with the field."""
    scene, pinholes = fitted.scene, fitted.pinholes
    split = next(name for name in ("test", "val", "train") if scene.splits.get(name))
    views = evenly_spaced_subset(scene.splits[split], max_views)
    behind = color_behind(background)
    of_splats, of_field = [], []
    panels: list[tuple[str, Tensor]] = []
    for number, view in enumerate(views):
        field = rendered(model, scene, pinholes, view, tile_points, background).rgb.clamp(0, 1)
        splats = rasterize(gaussians, Pinhole.of(pinholes, view, float(scene.near[view])), behind).clamp(0, 1)
        truth, kept = field, None
        if isinstance(scene, Scene):
            taken = photographed(scene, view, pinholes)
            truth, kept = taken.over(behind), taken.mask
            of_field.append(image_metrics(field, truth, kept))
        of_splats.append(image_metrics(splats, truth, kept))
        named = [("photograph", truth)] if isinstance(scene, Scene) else []
        panels = panels or [*named, ("field", field), ("splats", splats)]
        report("comparing", (number + 1) / len(views))
    said = f"{len(views)} {split} view{'s' if len(views) > 1 else ''}"
    return Comparison(said, mean_over_images(of_splats), mean_over_images(of_field) if of_field else None, panels)
