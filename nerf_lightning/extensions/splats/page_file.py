"""The content of a page file."""

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from markupsafe import Markup
from PIL import Image
from torch import Tensor
from torch.nn import functional

from nerf_lightning.export.base import RunContext
from nerf_lightning.extensions.splats.fitted import as_faces
from nerf_lightning.extensions.splats.gaussians import DILATION, Gaussians, Pinhole
from nerf_lightning.extensions.splats.page_marks import Marks
from nerf_lightning.extensions.splats.quantized import QuantizedSplats
from nerf_lightning.extensions.splats.rasterizer import rasterize
from nerf_lightning.extensions.splats.views import color_behind, without_lens
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.html import data_address, json_in_page, own_policy, rendered
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.geometry.world_frame import central_view, gaps_around
from nerf_lightning.nerf.rendering.background import at_evaluation, photograph
from nerf_lightning.nerf.types.scene import Background, Cameras, SceneRecord
from nerf_lightning.visualization.pictures import color_map, to_bytes

FOLDER = Path(__file__).parent / "page_files"
SCRIPTS = ("page.js", "splats.js", "path.js", "marks.js")
SHADERS = ("splats.vert", "splats.frag")
NEAR_NDC = 0.2  # Share of the distance at which content begins.
INSIDE = 0.01  # Share of the splats beyond either side of the box around which the view orbits.
BACKGROUND_COLORS: dict[Background, str] = {"white": "#ffffff", "black": "#000000", "none": "#000000"}
# Longer side in pixels of the still picture, and of photographs, which are compared with the scene.
STILL, PHOTOGRAPH = 640, 800
QUALITY = 80  # Of WebP.
DEPTH_COLORS = 17  # Straight lines between these follow the report's scale.
PART_OF_PANORAMA = 1.5  # Field of view around a panorama's direction, in radians.
# With a wider gap, cameras do not surround the scene: the page then sways, at most this far to either side.
WIDEST_GAP, MOST_SWAY = 120.0, 20.0  # Degrees.


@dataclass(frozen=True)
class ViewOnPage:
    """A place to jump to."""

    name: str
    source: str
    """The photograph as a data URL; empty if there is none."""


def write_page(
    target: Path,
    splats: QuantizedSplats,
    focal: float,
    record: SceneRecord,
    run: RunContext,
    max_photographs: int,
    facts: list[tuple[str, str]],
    marks: Marks,
    title: str | None = None,
    first_view: str | None = None,
) -> None:
    """Write the page of splats, with facts about them, and one to `max_photographs` places to jump to.

    `focal` is that of the pictures that they were fitted to, in pixels. The view of `marks`, or the photograph, named
    `first_view` is shown first; None: the most central training view.
    """
    packed, shown = splats.packed(), splats.gaussians()
    views = evenly_spaced_subset(range(len(record.view_names)), max(1, max_photographs))
    names = [view["name"] for view in marks["views"]]
    is_photograph = first_view in record.view_names and first_view not in names
    first = record.view_names.index(first_view) if is_photograph else central_view(record)
    if first not in views:
        views = sorted([*views[1:], first])
    middle, radius = _middle(shown, record, run.crop is not None)
    up = functional.normalize(record.cameras.c2w[:, :, 1].mean(dim=0), dim=0)
    about = splats.described() | {
        "bytes": len(packed),
        "focal": focal,
        "dilation": DILATION,
        "depth_colors": color_map(torch.linspace(0, 1, DEPTH_COLORS)[None], 0.0, 1.0)[0].tolist(),
        "near": _nearest(record),
        "unbounded": record.space == "contracted",
        "cameras": [_camera(record.cameras, view) for view in views],
        "first": views.index(first),
        "first_view": names.index(first_view) if first_view in names else None,
        "marks": marks,
        "metres": record.metres_per_unit,
        "sway": sway(record, middle, up),
        "middle": middle,
        "radius": radius,
        "up": up.tolist(),
        "path": list(run.keyframes),
        "to_user": record.to_user.tolist(),
        # A film has the aspect ratio of the first photograph.
        "film": [int(record.cameras.width[0]), int(record.cameras.height[0])],
    }
    page = {
        "title": title or run.name or record.name,
        "facts": [
            ("This page", facts),
            ("Model", run.facts),
        ],
        "views": [_view(record, run, view if max_photographs else None) for view in views],
        "still": _webp(_still(shown, record, first), STILL),
        "background": BACKGROUND_COLORS[at_evaluation(record.background)],
    }
    style, vertices, pixels, *scripts = (
        (FOLDER / name).read_text(encoding="utf-8") for name in ("page.css", *SHADERS, *SCRIPTS)
    )
    script = "\n".join(scripts)
    text = rendered(
        FOLDER / "page.html",
        page=page,
        policy=own_policy(script, style),
        about=json_in_page(about),
        script=Markup(script),
        style=Markup(style),
        vertices=Markup(vertices),
        pixels=Markup(pixels),
        splats=Markup(base64.b64encode(packed).decode()),
    )
    with whole_file(target) as part:
        part.write_text(text, encoding="utf-8")


def sway(record: SceneRecord, middle: Sequence[float], up: Float[Tensor, "3"]) -> float | None:
    """Return how far the page turns to either side, in radians; None: all around, like the training cameras."""
    away = record.cameras.c2w[list(record.splits["train"]), :, 3] - torch.tensor(middle)
    first = functional.normalize(away[0] - (away[0] @ up) * up, dim=0)
    azimuth = torch.rad2deg(torch.atan2(away @ torch.linalg.cross(up, first), away @ first))
    gap = float(gaps_around(azimuth)[1].max())
    return None if gap < WIDEST_GAP else math.radians(min(MOST_SWAY, (360.0 - gap) / 4))


def _middle(splats: Gaussians, record: SceneRecord, is_part: bool) -> tuple[list[float], float]:
    """Return the center of the orbit, and the distance of the content from it, in the world; `is_part` of the scene."""
    if record.space == "ndc" and not is_part:
        return [0.0, 0.0, -2.0], 1.0
    lower, upper = record.aabb
    if record.space == "bounded" or is_part:
        lower, upper = (torch.from_numpy(np.quantile(splats.means.numpy(), at, axis=0)) for at in (INSIDE, 1 - INSIDE))
    return ((lower + upper) / 2).tolist(), float((upper - lower).norm() / 2)


def _nearest(record: SceneRecord) -> float:
    """Return the minimum distance along a camera's axis at which splats are drawn."""
    return NEAR_NDC if record.space == "ndc" else float(record.near.min())


def _still(splats: Gaussians, record: SceneRecord, view: int) -> Float[Tensor, "height width 3"]:
    if record.cameras.lens_model == "equirectangular":
        record, view = as_faces(record), 6 * view
    camera = Pinhole.of(without_lens(record.cameras, STILL), view, float(record.near[view]))
    return rasterize(splats, camera, color_behind(record.background)).clamp(0, 1)


def _camera(cameras: Cameras, view: int) -> dict[str, Any]:
    right, up, back, eye = cameras.c2w[view].T.tolist()
    width, height = int(cameras.width[view]), int(cameras.height[view])
    focal, center = cameras.focal[view].tolist(), cameras.center[view].tolist()
    if cameras.lens_model == "equirectangular":
        focal, center = [height / PART_OF_PANORAMA] * 2, [width / 2, height / 2]
    return {"eye": eye, "axes": [right, up, back], "focal": focal, "center": center, "width": width, "height": height}


def _view(record: SceneRecord, run: RunContext, view: int | None) -> ViewOnPage:
    if view is None:
        return ViewOnPage("start", "")
    name, scene = record.view_names[view], run.photographs
    # A panorama would not match what is seen from its position.
    if scene is None or name not in scene.view_names or record.cameras.lens_model == "equirectangular":
        return ViewOnPage(name, "")
    return ViewOnPage(name, _webp(photograph(scene, scene.view_names.index(name), scene.background), PHOTOGRAPH))


def _webp(picture: Float[Tensor, "height width 3"], longest: int) -> str:
    image = Image.fromarray(to_bytes(torch.as_tensor(picture)).contiguous().numpy())
    image.thumbnail((longest, longest))
    content = io.BytesIO()
    image.save(content, format="WEBP", quality=QUALITY)
    return data_address("image/webp", content.getvalue())
