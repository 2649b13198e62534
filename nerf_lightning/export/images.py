"""Depth, opacity and normals of the views, as pictures and arrays."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from PIL import Image

from nerf_lightning.data.pixels.picture_files import ENDINGS
from nerf_lightning.export.base import MODEL_ALONE, Export, RunContext, require_free, require_setting
from nerf_lightning.export.visibility import SeenView, require_room, see
from nerf_lightning.files.atomic import whole_file
from nerf_lightning.files.json_files import write_json
from nerf_lightning.files.made_folders import child_of, file_name, make_folder
from nerf_lightning.messages.console import StageProgress, say
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import camera_coordinates
from nerf_lightning.nerf.geometry.subset import evenly_spaced_subset
from nerf_lightning.nerf.geometry.world_frame import directions_to_user, told_length
from nerf_lightning.nerf.models.base import Model
from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.visualization.pictures import save_png, to_bytes

DepthKind = Literal["distance", "z"]
Split = Literal["train", "val", "test", "all"]
LARGEST = 65_535
KINDS = ("depth", "opacity", "normals")
MILLIMETRE = 1e-3


@dataclass
class ImagesExport(Export):
    """Write folders of pictures: `depth` (16-bit PNG, and float32 .npy), `opacity`, `normals`, and `images.json`.

    Each channel of the model's field has a folder of float32 .npy arrays.

    If the capture's unit is known, depth is in meters, and the PNG in millimeters like that of depth cameras, unless
    something is farther away than its range.

    Args:
        split: the split whose views are exported.
        max_views: maximum number of views, spread over all; None: all.
        depth: `distance` along the pixel's ray, or `z` along the camera's axis.
    """

    needs_density = False

    split: Split = "test"
    max_views: int | None = None
    depth: DepthKind = "distance"

    def __post_init__(self) -> None:
        some = self.max_views is None or self.max_views >= 1
        require_setting("max_views", self.max_views, some, "give at least one view, or null for all.")

    def export(
        self, model: Model, record: SceneRecord, folder: Path, tile_points: int, run: RunContext = MODEL_ALONE
    ) -> list[Path]:
        """Write the pictures; all share one depth scale, so the PNG files come last."""
        require_free(files=[folder / "images.json"], folders=[folder / name for name in KINDS])
        views = self._views(record)
        require_room(record.cameras, views, record.view_names)
        names = {view: _file_name(view, record.view_names[view]) for view in views}
        depths, opacities, directions = (make_folder(folder, name) for name in KINDS)
        farthest, channels = 0.0, dict[str, Path]()
        with StageProgress({"pictures": 10.0, "depth": 1.0}) as report:
            for number, view in enumerate(views):
                rendered = see(model, record, record.cameras, view, tile_points)
                depth = self._depth(rendered, record, view, run.min_opacity)
                _save_array(child_of(depths, names[view], ending=".npy"), depth)
                farthest = max(farthest, float(np.nanmax(depth, initial=0.0)))
                save_png(child_of(opacities, names[view], ending=".png"), to_bytes(rendered.opacity))
                normals = 0.5 + 0.5 * directions_to_user(rendered.normals.double(), record.to_user.double())
                save_png(child_of(directions, names[view], ending=".png"), to_bytes(normals))
                for name, values in rendered.channels.items():
                    channels[name] = make_folder(folder, name)
                    _save_array(child_of(channels[name], names[view], ending=".npy"), values.numpy())
                report("pictures", (number + 1) / len(views))
            in_millimetres = record.metres_per_unit is not None and farthest <= MILLIMETRE * LARGEST
            scale = MILLIMETRE if in_millimetres else farthest / LARGEST or 1.0
            for number, view in enumerate(views):
                depth = np.nan_to_num(np.load(child_of(depths, names[view], ending=".npy")), nan=0.0)
                with whole_file(child_of(depths, names[view], ending=".png")) as part:
                    Image.fromarray(np.rint(depth / scale).astype(np.uint16)).save(part, format="PNG")
                report("depth", (number + 1) / len(views))
        about = folder / "images.json"
        write_json(about, self._described(record, names, scale))
        said = "millimeters" if in_millimetres else f"{scale:.4g} of these"
        say(f"depth        in {told_length(record)[1]}; a step of the 16-bit PNG is {said}")
        return [depths, opacities, directions, *channels.values(), about]

    def _views(self, record: SceneRecord) -> list[int]:
        everything = tuple(range(len(record.view_names)))
        views = everything if self.split == "all" else record.splits.get(self.split, ())
        if not views:
            raise InputError(f"{record.name} has no {self.split} views. Choose another split with what.split=...")
        return evenly_spaced_subset(views, self.max_views or len(views))

    def _depth(
        self, rendered: SeenView, record: SceneRecord, view: int, min_opacity: float
    ) -> Float[ndarray, "height width"]:
        depth = rendered.depth
        if self.depth == "z":
            depth = -camera_coordinates(record.cameras, view, rendered.points)[..., 2]
        opaque = rendered.surface_depth(min_opacity).isfinite()
        return torch.where(opaque, told_length(record)[0] * depth.double(), torch.nan).float().numpy()

    def _described(self, record: SceneRecord, names: dict[int, str], scale: float) -> dict[str, Any]:
        along = "along the pixel's ray" if self.depth == "distance" else "along the camera's axis"
        return {
            "scene": record.name,
            "depth": f"{along}, from the camera, in {told_length(record)[1]}; .npy: NaN where nothing is; .png: times "
            "depth_scale, 0 where nothing is",
            "metres_per_unit": record.metres_per_unit,
            "depth_scale": scale,
            "opacity": "8 bits, 255 is opaque",
            "normals": "8 bits, (n + 1) / 2, in the capture's axes, facing the camera",
            "views": {record.view_names[view]: name for view, name in names.items()},
        }


def _file_name(view: int, name: str) -> str:
    """Return the name of a view's files, without their extension and that of the photograph."""
    ending = Path(name).suffix
    stem = name.removesuffix(ending) if ending.lower() in ENDINGS else name
    return file_name(f"{view:04d}_{stem}", ".png").removesuffix(".png")


def _save_array(path: Path, array: Float[ndarray, "height width *channels"]) -> None:
    # Given a file, NumPy writes through C buffers, and reports nothing if the disk is too full for the last one.
    content = io.BytesIO()
    np.save(content, array)
    with whole_file(path) as part:
        part.write_bytes(content.getbuffer())
