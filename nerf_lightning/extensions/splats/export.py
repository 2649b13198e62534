"""Export splats: fit them, compare them with the field, and write them."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Float64
from torch import Tensor

from nerf_lightning.export.base import MODEL_ALONE, RunContext, require_free, require_setting
from nerf_lightning.extensions.splats.comparison import compared
from nerf_lightning.extensions.splats.files import (
    HALF_TURN,
    IN_METERS,
    SplatFormat,
    moved,
    moved_cameras,
    require_library,
    save_splats,
)
from nerf_lightning.extensions.splats.fitted import SplatFitting, cropped
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.made_folders import child_of
from nerf_lightning.messages.console import StageProgress, say
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, y_up
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import mosaic, save_png, to_bytes


@dataclass
class SplatsExport(SplatFitting):
    """Write `splats.ply` (or another format), `splats.json` with measurements, and `splats.png` for inspection.

    Args:
        num_splats: maximum number of splats; auto: 200 times the square root of a view's number of
            pixels, at most 150,000.
        seconds: seconds of fitting to the training photographs; without them, to renders of the field; 0: no
            fitting.
        sh_degree: degree of the spherical harmonics of colors, 0 to 3; 0: the same color from everywhere.
        format: the file format: ply, sog (for the web, a tenth of the size), spz (a sixth), glb (glTF with
            KHR_gaussian_splatting) or usda (OpenUSD 26.03, with the cameras). SPZ needs `pip install '.[splats]'`.
        frame: upright, so that the scene is upright in viewers, or capture, the capture's own axes (GLB and USDA are
            always upright).
        longest: maximum length of the longer side of the images used for fitting, in pixels.
        max_views: maximum number of held-out views on which splats and field are compared, at least 1.
        seed: the seed of the initial splats and of the order of views.
    """

    format: SplatFormat = "ply"
    frame: Literal["upright", "capture"] = "upright"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_setting("max_views", self.max_views, self.max_views >= 1, "give 1 or more.")

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Fit, compare and write."""
        path, facts, picture = (child_of(folder, f"splats.{end}") for end in (self.format, "json", "png"))
        require_free(files=[path, facts, picture])
        if self.format == "spz":
            require_library()  # before the work, not after it
        began = time.monotonic()
        with StageProgress(self.stages()) as report:
            found = self.fitted(model, record, run, tile_points, report)
            chosen = record.background, self.max_views, tile_points
            comparison = compared(found, found.gaussians, model, *chosen, report)
        shown, to_file = cropped(found.gaussians, run), self._to_file(record)
        pinholes = record.cameras.lens_model != "equirectangular"
        save_splats(path, moved(shown, to_file), moved_cameras(record.cameras, to_file) if pinholes else None)
        known: dict[str, Any] = {"splats": len(shown), "bytes": path.stat().st_size}
        known |= {"seconds": round(time.monotonic() - began, 1), "fitting_seconds": self.seconds}
        known |= {"fitted_to": found.truth, "views": comparison.views}
        known |= {} if run.crop is None else {"measured": "the whole scene, without the crop box"}
        known |= {"splats_metrics": comparison.splats} | (
            {"field_metrics": comparison.field} if comparison.field else {}
        )
        with whole_file(facts) as part:
            part.write_text(json.dumps(known, indent=2) + "\n", encoding="utf-8")
        save_png(picture, mosaic((name, to_bytes(each)) for name, each in comparison.panels))
        size = f"{known['splats']:,} in {known['bytes'] / 1e6:.1f} MB, fitted to {known['fitted_to']}"
        say(f"splats       {size} for {self.seconds:g} s ({known['seconds']:.0f} s in all)")
        say(f"PSNR         {comparison.psnr()}")
        return [path, facts, picture]

    def _to_file(self, record: SceneRecord) -> Float64[Tensor, "4 4"]:
        """Return the transform from scene to file coordinates: the capture's own, or rotated until y points down.

        glTF and USD also require meters, if known.
        """
        to_user = record.to_user.double()
        if self.frame == "capture" and self.format not in IN_METERS:
            return to_user
        up = torch.tensor([0.0, 1.0, 0.0] if record.space == "ndc" else [0.0, 0.0, 1.0], dtype=torch.float64)
        matrix = HALF_TURN @ y_up(directions_to_user(up, to_user)) @ to_user
        matrix[:3] *= (record.metres_per_unit or 1.0) if self.format in IN_METERS else 1.0
        return matrix
