"""Export splats: begin on the field's surfaces, fit to the photographs, measure beside the field, write."""

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from nerf_lightning.evaluation.metrics import image_metrics, mean_over_images
from nerf_lightning.export.base import Export, require_free, require_setting
from nerf_lightning.export.density_grid import Report
from nerf_lightning.extensions.splats.files import HALF_TURN, SplatFormat, moved, require_library, save_splats
from nerf_lightning.extensions.splats.fit import Fitting, fit
from nerf_lightning.extensions.splats.gaussians import Gaussians, Pinhole
from nerf_lightning.extensions.splats.initialize import initial_gaussians, look_around
from nerf_lightning.extensions.splats.rasterizer import rasterize
from nerf_lightning.extensions.splats.views import View, color_behind, photographed, rendered, without_lens
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.messages.console import StageProgress, say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.frames import directions_to_user, y_up
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.kernels.backends import backend, why_not
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import Cameras, Scene, SceneRecord
from nerf_lightning.visualization.pictures import mosaic, save_png, to_bytes

ROOM = "nerf_lightning.extensions.splats"
KERNELS = (f"{ROOM}.projection", f"{ROOM}.tiles")
PER_SIDE, MOST = 200, 150_000
MOST_SHOWN = 3_000_000  # 500 MB as PLY.


@dataclass
class SplatsExport(Export):
    """Write `splats.ply`, `.spz` or `.glb`, `splats.json` with what was measured, and `splats.png` to look at.

    Args:
        num_splats: maximum number of splats; auto: 200 per pixel of a view's side, at most 150,000.
        seconds: seconds of fitting to the training photographs; without them, or if the model has a correction per
            photograph, to renders of the field; 0: no fitting.
        sh_degree: degree of the spherical harmonics of colors, 0 to 3; 0: the same color from everywhere.
        format: the file format: ply, spz (a sixth of the size) or glb (glTF with KHR_gaussian_splatting). SPZ needs
            `pip install 'nerf-lightning[splats]'`.
        frame: upright, so that the scene is upright in viewers, or capture, the capture's own axes (GLB is always
            upright).
        longest: maximum length of the longer side of the images used for fitting, in pixels.
        max_views: maximum number of held-out views on which splats and field are compared.
        seed: the seed of the initial splats and of the order of views.
    """

    needs_photographs = True
    kernels = KERNELS

    num_splats: int | Literal["auto"] = "auto"
    seconds: float = 60.0
    sh_degree: int = 2
    format: SplatFormat = "ply"
    frame: Literal["upright", "capture"] = "upright"
    longest: int = 800
    max_views: int = 16
    seed: int = 0

    def __post_init__(self) -> None:
        shown = self.num_splats == "auto" or 1 <= self.num_splats <= MOST_SHOWN
        rule = f"give 1 to {MOST_SHOWN:,} splats, which is what viewers show, or auto."
        require_setting("num_splats", self.num_splats, shown, rule)
        require_setting("seconds", self.seconds, self.seconds >= 0, "give seconds of fitting, 0 or more.")
        require_setting("sh_degree", self.sh_degree, 0 <= self.sh_degree <= 3, "give 0, 1, 2 or 3.")
        require_setting("longest", self.longest, self.longest >= 16, "give 16 pixels or more.")
        require_setting("max_views", self.max_views, self.max_views >= 1, "give 1 or more.")

    def export(self, model: Model, record: SceneRecord, folder: Path, tile_points: int) -> list[Path]:
        """Fit, measure and write."""
        path, facts, picture = (folder / f"splats.{end}" for end in (self.format, "json", "png"))
        require_free(files=[path, facts, picture])
        self._require_possible(record)
        began = time.monotonic()
        photographs = None if self.beside.corrected else self.beside.photographs
        scene = record if photographs is None else photographs
        pinholes = without_lens(scene.cameras, self.longest)
        budget = self._budget(pinholes)
        with StageProgress({"surfaces": 15.0, "fitting": self.seconds, "measured": 5.0}) as report:
            around = look_around(model, record, tile_points, self.seed, report)
            first = max(1, budget // 2) if self.seconds else budget
            gaussians = initial_gaussians(around, first, self.sh_degree, self.seed)
            if self.seconds:
                views = [] if photographs is None else training_views(record, photographs, pinholes)
                fitting = Fitting(budget, self.seconds, record.background, extent(pinholes), self.seed)
                with torch.enable_grad():
                    gaussians = fit(gaussians, views, around.views(), fitting, report)
            measured, panels = self._measured(gaussians, model, record, scene, pinholes, tile_points, report)
        save_splats(path, moved(gaussians, self._to_file(record)))
        whole: dict[str, Any] = {"splats": len(gaussians), "bytes": path.stat().st_size}
        whole |= {"seconds": round(time.monotonic() - began, 1), "fitting_seconds": self.seconds}
        whole |= {"fitted_to": "the field" if photographs is None else "photographs"} | measured
        with whole_file(facts) as part:
            part.write_text(json.dumps(whole, indent=2) + "\n", encoding="utf-8")
        save_png(picture, panels)
        say(*_lines(whole))
        return [path, facts, picture]

    def _require_possible(self, record: SceneRecord) -> None:
        if record.cameras.lens_model == "equirectangular":
            raise InputError(
                f"what=splats: {record.name} consists of panoramas, and splats are fitted to pinhole pictures. "
                "what=points and what=mesh accept panoramas."
            )
        if self.format == "spz":
            require_library()  # before the work, not after it
        for module in KERNELS:
            if backend(module) is None:
                raise InputError(f"what=splats needs numba, which cannot be used here ({why_not(module)}).")

    def _to_file(self, record: SceneRecord) -> Float64[Tensor, "4 4"]:
        """Return what takes scene coordinates to the file's: the capture's own, or turned until y points down.

        glTF also wants meters, as far as they are known.
        """
        to_user = record.to_user.double()
        if self.frame == "capture" and self.format != "glb":
            return to_user
        up = torch.tensor([0.0, 1.0, 0.0] if record.space == "ndc" else [0.0, 0.0, 1.0], dtype=torch.float64)
        matrix = HALF_TURN @ y_up(directions_to_user(up, to_user)) @ to_user
        matrix[:3] *= (record.metres_per_unit or 1.0) if self.format == "glb" else 1.0
        return matrix

    def _budget(self, pinholes: Cameras) -> int:
        pixels = int((pinholes.width * pinholes.height).double().mean())
        return min(PER_SIDE * math.isqrt(pixels), MOST) if self.num_splats == "auto" else self.num_splats

    def _measured(
        self,
        gaussians: Gaussians,
        model: Model,
        record: SceneRecord,
        scene: SceneRecord,
        pinholes: Cameras,
        tile_points: int,
        report: Report,
    ) -> tuple[dict[str, Any], Tensor]:
        """Compare splats and field with the photographs of held-out views, or, without them, with each other."""
        split = next(name for name in ("test", "val", "train") if scene.splits.get(name))
        views = evenly_spaced_subset(scene.splits[split], self.max_views)
        background = color_behind(record.background)
        of_splats, of_field, panels = [], [], None
        for number, view in enumerate(views):
            field = rendered(model, scene, pinholes, view, tile_points, record.background).rgb.clamp(0, 1)
            splats = rasterize(gaussians, Pinhole.of(pinholes, view, float(scene.near[view])), background).clamp(0, 1)
            truth, kept = field, None
            if isinstance(scene, Scene):
                taken = photographed(scene, view, pinholes)
                truth, kept = taken.over(background), taken.kept
                of_field.append(image_metrics(field, truth, kept))
            of_splats.append(image_metrics(splats, truth, kept))
            named = [("photograph", truth)] if isinstance(scene, Scene) else []
            panels = panels or [*named, ("field", field), ("splats", splats)]
            report("measured", (number + 1) / len(views))
        measured: dict[str, Any] = {"views": f"{len(views)} {split}", "splats_metrics": mean_over_images(of_splats)}
        if of_field:
            measured["field_metrics"] = mean_over_images(of_field)
        assert panels is not None
        return measured, mosaic((name, to_bytes(each)) for name, each in panels)


def training_views(record: SceneRecord, scene: Scene, pinholes: Cameras) -> list[View]:
    """Return the photographs that the model learned from, by its record, and of which anything counts."""
    trained = {record.view_names[view] for view in record.splits["train"]}
    known = [view for view in scene.splits["train"] if scene.view_names[view] in trained]
    views = [photographed(scene, view, pinholes) for view in known]
    return [view for view in views if view.kept is None or bool(view.kept.any())]


def extent(cameras: Cameras) -> float:
    """Return how far the cameras are from their middle, at most (scene units)."""
    eyes = cameras.c2w[:, :, 3]
    return max(float((eyes - eyes.mean(dim=0)).norm(dim=-1).max()), 1e-6)


def _lines(known: dict[str, Any]) -> list[str]:
    """Return what a person may want to know."""
    splats, field = known["splats_metrics"], known.get("field_metrics")
    psnr = f"{splats['psnr']:.2f} dB on {known['views']} views"
    if field is None:
        psnr += ", with the field's renders as the truth"
    else:
        ssim = "" if field["ssim"] is None else f"; SSIM {splats['ssim']:.3f} and {field['ssim']:.3f}"
        gain = splats["psnr"] - field["psnr"]
        psnr += f", the field {field['psnr']:.2f} dB: {abs(gain):.2f} dB {'gained' if gain >= 0 else 'lost'}{ssim}"
    size = f"{known['splats']:,} in {known['bytes'] / 1e6:.1f} MB, fitted to {known['fitted_to']}"
    return [
        f"splats       {size} for {known['fitting_seconds']:g} s ({known['seconds']:.0f} s in all)",
        f"PSNR         {psnr}",
    ]
