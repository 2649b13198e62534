"""Measure a model on the views of a split: numbers per picture, their mean, and the protocol of both."""

import csv
import hashlib
import json
import time
from pathlib import Path
from typing import Any, Literal

from rich.progress import track
from torch import Tensor

from nerf_lightning import ranks
from nerf_lightning.commands.console import stderr_console
from nerf_lightning.errors import InputError
from nerf_lightning.evaluation.geometry import depth_error, normal_error, normals_from_depth, surface_depth
from nerf_lightning.evaluation.lpips import LPIPS_HINT, load_lpips
from nerf_lightning.evaluation.metrics import image_metrics, masked_out, mean_over_images
from nerf_lightning.export.atomic import whole_file
from nerf_lightning.export.pictures import mosaic, save_png
from nerf_lightning.geometry.cameras import all_pixels, rays_through_pixels
from nerf_lightning.geometry.frames import unit_of
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.pictures import Picture, render_picture
from nerf_lightning.rendering.blending import photograph
from nerf_lightning.types import Background, Scene

METRICS = ("psnr", "ssim", "lpips", "depth_error", "normal_error")


class Scoring:
    """What is measured and how.

    Args:
        split: train, val or test.
        max_views: most views, evenly spread over the split; None for all.
        quantize: round the render to 8 bits first, as a saved picture would be.
        num_pictures: how many comparison pictures are kept.
        lpips_weights: a file with the backbone's weights; None: LPIPS is not computed.
        lpips_net: the backbone, alex or vgg.
    """

    def __init__(
        self,
        split: Literal["train", "val", "test"] = "test",
        max_views: int | None = None,
        quantize: bool = False,
        num_pictures: int = 5,
        lpips_weights: str | None = None,
        lpips_net: Literal["alex", "vgg"] = "alex",
    ):
        if max_views is not None and max_views < 1:
            raise InputError(f"evaluation.max_views={max_views}: give at least one view, or null for all.")
        self.split, self.max_views, self.quantize, self.num_pictures = (
            split,
            max_views,
            quantize,
            num_pictures,
        )
        self.lpips = load_lpips(lpips_weights, lpips_net)

    def score(
        self, model: RadianceModel, scene: Scene, background: Background, tile_points: int, folder: Path
    ) -> dict[str, Any]:
        """Render the views, write `metrics.json`, `metrics.csv` and pictures into `folder`, and return the metrics.

        Depth errors are in scene units, normal errors in degrees; both only for scenes that know the truth.
        """
        views = self._views(scene)
        kept = {views[i * len(views) // self.num_pictures] for i in range(self.num_pictures)} if views else set()
        rows: list[dict[str, Any]] = []
        started = time.perf_counter()
        mine = ranks.every_other(views)
        for view in track(mine, description=f"evaluating {self.split}", transient=True, console=stderr_console()):
            picture = render_picture(model, scene.cameras, view, scene.near, scene.far, background, tile_points)
            truth = photograph(scene, view, background)
            if self.quantize:
                picture = Picture((picture.rgb.clamp(0, 1) * 255).round() / 255, picture.depth, picture.opacity)
            rows.append({"name": scene.view_names[view]} | self._measure(picture, truth, scene, view))
            if view in kept:
                panel = mosaic(truth, picture.rgb, unit_of(scene.to_user) * picture.depth, picture.opacity)
                save_png(folder / "images" / _file_name(self.split, scene.view_names[view]), panel)
        rows = ranks.in_turn(rows)
        result: dict[str, Any] = mean_over_images([{m: row[m] for m in METRICS} for row in rows]) | {
            "num_images": len(rows),
            "seconds_per_image": (time.perf_counter() - started) / len(rows),
            "per_image": rows,
            "protocol": self._protocol(scene, views, background),
        }
        if result["lpips"] is None:
            result["lpips_hint"] = LPIPS_HINT
        if ranks.is_first():
            write_metrics(folder, result)
        return result

    def _views(self, scene: Scene) -> list[int]:
        views = scene.splits.get(self.split, ())
        if not views:
            raise InputError(
                f"The scene {scene.name} has no {self.split} views. Choose another split with evaluation.split=..."
            )
        count = len(views) if self.max_views is None else min(self.max_views, len(views))
        return [views[i * len(views) // count] for i in range(count)]

    def _measure(self, picture: Picture, truth: Tensor, scene: Scene, view: int) -> dict[str, float | None]:
        kept = scene.pixels.kept(view)
        values: dict[str, float | None] = dict(image_metrics(picture.rgb, truth, kept))
        compared = masked_out(picture.rgb, truth, kept)
        values["lpips"] = None if self.lpips is None else self.lpips.score(compared, truth)
        return values | _geometry_errors(picture, scene, view)

    def _protocol(self, scene: Scene, views: list[int], background: Background) -> dict[str, Any]:
        sizes = sorted({(int(scene.cameras.width[v]), int(scene.cameras.height[v])) for v in views})
        return {
            "scene": scene.name,
            "split": self.split,
            "split_hash": split_hash(scene, views),
            "background": "white" if background == "random" else background,
            "resolution": [list(size) for size in sizes],
            "pixels": "8-bit" if self.quantize else "float",
            "psnr": "mean of the pictures' own",
            "ssim": "torchmetrics, Gaussian 11 x 11, sigma 1.5",
            **({} if scene.pixels.mask is None else {"masks": "left out"}),
            **scene.protocol,
        }


def split_hash(scene: Scene, views: list[int]) -> str:
    """Return a fingerprint of names, pixels and masks, so that numbers on different pictures are not compared."""
    digest = hashlib.sha256()
    for view in views:
        digest.update(scene.view_names[view].encode())
        digest.update(scene.pixels.view(view).contiguous().numpy().tobytes())
        kept = scene.pixels.kept(view)
        if kept is not None:
            digest.update(kept.numpy().tobytes())
    return digest.hexdigest()[:16]


def write_metrics(folder: Path, result: dict[str, Any]) -> None:
    """Write `metrics.json`, and `metrics.csv` with a row per picture."""
    with whole_file(folder / "metrics.json") as part:
        part.write_text(json.dumps(result, indent=2) + "\n")
    with whole_file(folder / "metrics.csv") as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, ["name", *METRICS])
        writer.writeheader()
        writer.writerows(result["per_image"])


def _geometry_errors(picture: Picture, scene: Scene, view: int) -> dict[str, float | None]:
    if scene.truth is None:
        return {"depth_error": None, "normal_error": None}
    shape = picture.depth.shape
    start = int(scene.pixels.offset[view])
    part = slice(start, start + picture.depth.numel())
    alpha = (scene.pixels.rgba[part, 3].float() / 255.0).view(shape)
    kept = scene.pixels.kept(view)
    if kept is not None:
        alpha = alpha * kept  # only what is wholly covered is scored
    true_depth, true_normals = scene.truth.depth[part].view(shape), scene.truth.normals[part].view(*shape, 3)
    far = scene.far[view].expand(shape)
    rays = rays_through_pixels(scene.cameras, all_pixels(scene.cameras, view), scene.near, scene.far)
    surface = surface_depth(picture.depth, picture.opacity, far)
    normals = normals_from_depth(rays.origins + surface[..., None] * rays.directions)
    return {
        "depth_error": depth_error(picture.depth, picture.opacity, far, true_depth, alpha),
        "normal_error": normal_error(normals, true_normals, alpha),
    }


def _file_name(split: str, view_name: str) -> str:
    plain = view_name.replace("/", "_").replace("\\", "_")
    return f"{plain}.png" if plain.startswith(f"{split}_") else f"{split}_{plain}.png"
