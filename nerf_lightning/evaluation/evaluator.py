"""Measure a model on the views of a split: metrics per picture, their summary, and the protocol of the measurement.

Formulas, and means over pictures: `metrics.py`. `conf/evaluation/default.yaml` has the defaults; `conf/train.yaml`
changes them for the end of training.
"""

import logging
import time
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from nerf_lightning.compute import ranks
from nerf_lightning.compute.environment import environment
from nerf_lightning.evaluation.camera_fit import fitted_camera
from nerf_lightning.evaluation.color_fit import exposure_fitted
from nerf_lightning.evaluation.geometry_errors import depth_error, normal_error
from nerf_lightning.evaluation.kept_views import KeptViews, ScoredView
from nerf_lightning.evaluation.lpips import LPIPS, Net
from nerf_lightning.evaluation.metrics import image_metrics, masked_out
from nerf_lightning.evaluation.metrics_files import of_captures, summary, write_metrics
from nerf_lightning.evaluation.protocol import Colors, measured_how
from nerf_lightning.messages.console import tracked
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.geometry.surfaces import normals_from_depth
from nerf_lightning.nerf.geometry.world_frame import told_length
from nerf_lightning.nerf.models.base import Model, show_photographs
from nerf_lightning.nerf.models.ray_generator import RayGenerator
from nerf_lightning.nerf.models.render_image import Picture, picture_surface, render_picture
from nerf_lightning.nerf.rendering.background import background_colors, photograph
from nerf_lightning.nerf.types.scene import Background, Scene
from nerf_lightning.visualization.pictures import joint_range

# Number of views that the range of the depth's colors is taken from, and the maximum length of their longer side.
PROBES, PROBE_PIXELS = 8, 32

log = logging.getLogger(__name__)


@dataclass
class Scoring:
    """What is measured and how.

    Args:
        split: train, val or test.
        max_views: maximum number of views, evenly spread over the split; None: all. auto: `nerf train` chooses, for its
            time budget; elsewhere all.
        quantize: round renders to 8 bits first, as in a saved image.
        num_pictures: number of views whose images are kept, evenly spread.
        num_worst: number of further views with the lowest PSNR.
        lpips: compute LPIPS on this network, alex or vgg, whose weights torchvision downloads once; None: do not.
        colors: raw compares renders unchanged; half_fit fits exposure and white balance to the left half of each
            photograph and compares the right halves (the protocol of NeRF in the Wild, arXiv 2008.02268).
        nearest_views: for models that render from photographs: also evaluate baselines without a model from this number
            of photographs: the nearest one, and their blend; null: no.
    """

    split: Literal["train", "val", "test"] = "test"
    max_views: int | Literal["auto"] | None = None
    quantize: bool = False
    num_pictures: int = 5
    num_worst: int = 3
    lpips: Net | None = None
    colors: Colors = "raw"
    nearest_views: int | None = None

    def __post_init__(self) -> None:
        if self.nearest_views is not None and self.nearest_views < 1:
            raise InputError(f"evaluation.nearest_views={self.nearest_views}: give at least one photograph, or null.")
        if self.max_views == "auto":
            self.max_views = None
        if self.max_views is not None and self.max_views < 1:
            raise InputError(f"evaluation.max_views={self.max_views}: give at least one view, or null for all.")
        for name, count in (("num_pictures", self.num_pictures), ("num_worst", self.num_worst)):
            if count < 0:
                raise InputError(f"evaluation.{name}={count}: give 0 or more.")
        self._lpips = None if self.lpips is None else LPIPS(self.lpips)

    def score(
        self,
        model: Model,
        scene: Scene,
        background: Background,
        tile_points: int,
        folder: Path,
        origin: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        """Render the views, write `metrics.json`, `metrics.csv` and pictures into `folder`, and return the metrics.

        Depth errors are in scene units, normal errors in degrees; both only for scenes that know the truth. `origin`
        says what was measured (`protocol.measured_of`), and is recorded with the metrics.
        """
        views = self._views(scene)
        if self.nearest_views is not None and model.baselines is None:
            raise InputError(
                f"evaluation.nearest_views={self.nearest_views} is for models that render from photographs, which this "
                "one does not. Leave it out."
            )
        shown_views = evenly_spaced_subset(views, self.num_pictures)
        show_photographs(model, scene)
        rays_of = RayGenerator.of_views(scene, model.needs_photographs)
        rows: list[dict[str, Any]] = []
        mine = ranks.every_other(views)
        depth_range = _depth_range(model, scene, rays_of, views, background, tile_points)
        with closing(KeptViews(folder, self.split, self.num_worst)) as kept:
            for view in tracked(mine, f"evaluating {self.split}"):
                if scene.refined and view not in scene.splits["train"]:
                    cameras = fitted_camera(model, scene, view, background, tile_points)
                    rays_of = RayGenerator(cameras, scene.near, scene.far)
                started = time.perf_counter()
                picture = render_picture(model, rays_of, view, background, tile_points)
                seconds = time.perf_counter() - started
                row, shown = self._compare(picture, scene, view, background, depth_range)
                if model.needs_photographs:
                    row["unseen"] = float((picture.opacity == 0).float().mean())
                rows.append(row | {"seconds": seconds})
                kept.watch(row["name"], row["psnr"], shown)
                if view in shown_views:
                    kept.save(row["name"], shown)
            rows = ranks.in_turn(rows)
            worst = kept.finish(rows)
        result = summary(rows) | {
            "split_views": len(scene.splits[self.split]),
            "pictures": [scene.view_names[view] for view in shown_views],
            "worst_views": worst,
            "depth_scale": dict(zip(("near", "far"), depth_range, strict=True)) | {"unit": told_length(scene)[1]},
            "protocol": measured_how(scene, self.split, views, background, self.quantize, self.lpips, self.colors),
            "origin": origin or {},
            "environment": environment(),
        }
        _warn_of_unseen(rows)
        if self.nearest_views is not None and model.baselines is not None and ranks.is_first():
            result["nearest_views"] = model.baselines(scene, views, background, self.nearest_views)
        if scene.capture_of is not None:
            names = {scene.view_names[view]: scene.captures[scene.capture_of[view]] for view in views}
            result["captures"] = of_captures(rows, names, scene.trained_captures)
        if ranks.is_first():
            write_metrics(folder, result)
        return result

    def _views(self, scene: Scene) -> list[int]:
        views = scene.splits.get(self.split, ())
        if not views:
            raise InputError(
                f"The scene {scene.name} has no {self.split} views. Choose another split with evaluation.split=..."
            )
        return evenly_spaced_subset(views, self.max_views if isinstance(self.max_views, int) else len(views))

    def _compare(
        self, picture: Picture, scene: Scene, view: int, background: Background, depth_range: tuple[float, float]
    ) -> tuple[dict[str, Any], ScoredView]:
        truth, kept = photograph(scene, view, background), scene.pixels.view_mask(view)
        scored = slice(None)
        if self.colors == "half_fit":
            scored = slice(truth.shape[1] // 2, None)
            left = torch.ones(truth.shape[:2], dtype=torch.bool) if kept is None else kept.clone()
            left[:, scored] = False
            behind = background_colors(background, 1, torch.device("cpu"), random=None)
            picture = replace(picture, rgb=exposure_fitted(picture.rgb, truth, picture.opacity, left, behind))
        if self.quantize:
            picture = replace(picture, rgb=(picture.rgb.clamp(0, 1) * 255).round() / 255)
        render, true, counts = picture.rgb[:, scored], truth[:, scored], None if kept is None else kept[:, scored]
        row: dict[str, Any] = {"name": scene.view_names[view], **image_metrics(render, true, counts)}
        row["lpips"] = None if self._lpips is None else self._lpips.score(masked_out(render, true, counts), true)
        unit, known = told_length(scene)[0], scene.truth
        true_depth = None if known is None else unit * known(view).depth.view(picture.depth.shape)
        shown = unit * picture.depth, picture.opacity, depth_range, true_depth
        return row | _geometry_errors(picture, scene, view), ScoredView(truth, picture.rgb, *shown)


def _depth_range(
    model: Model, scene: Scene, rays_of: RayGenerator, views: list[int], background: Background, tile_points: int
) -> tuple[float, float]:
    """Return near and far of what a few small views show, in meters or the user's units."""
    small, few = rays_of.at_most(PROBE_PIXELS), evenly_spaced_subset(views, PROBES)
    unit = told_length(scene)[0]
    pictures = (render_picture(model, small, view, background, tile_points) for view in few)
    return joint_range((unit * picture.depth, picture.opacity) for picture in pictures)


def _warn_of_unseen(rows: list[dict[str, Any]]) -> None:
    """Warn which views show what no photograph sees, if a model renders from photographs."""
    unseen = [(row["unseen"], row["name"]) for row in rows if row.get("unseen")]
    if unseen:
        share, name = max(unseen)
        log.warning(
            "%d of %d views have pixels whose rays no photograph sees, up to %.1f %% of a view (%s): they show the "
            "background, which says nothing about what is there.",
            len(unseen),
            len(rows),
            100.0 * share,
            name,
        )


def _geometry_errors(picture: Picture, scene: Scene, view: int) -> dict[str, float | None]:
    if scene.truth is None:
        return {"depth_error": None, "normal_error": None}
    shape = picture.depth.shape
    start = int(scene.pixels.offset[view])
    part = slice(start, start + picture.depth.numel())
    alpha = (scene.pixels.rgba[part, 3].float() / 255.0).view(shape)
    kept = scene.pixels.view_mask(view)
    if kept is not None:
        alpha = alpha * kept  # only fully covered pixels are scored
    truth = scene.truth(view)
    far = scene.far[view].expand(shape)
    _, points = picture_surface(RayGenerator(scene.cameras, scene.near, scene.far), view, picture)
    normals = normals_from_depth(points)
    return {
        "depth_error": depth_error(picture.depth, picture.opacity, far, truth.depth.view(shape), alpha),
        "normal_error": normal_error(normals, truth.normals.view(*shape, 3), alpha),
    }
