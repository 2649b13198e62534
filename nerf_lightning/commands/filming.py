"""Render a model along a camera path: colour and depth, as videos or as frames."""

import logging
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, UInt8
from rich.progress import track
from torch import Tensor

from nerf_lightning import ranks
from nerf_lightning.checkpoints import SceneRecord
from nerf_lightning.commands.console import stderr_console
from nerf_lightning.errors import InputError
from nerf_lightning.export.pictures import depth_picture, to_bytes
from nerf_lightning.export.video import write_frames, write_video
from nerf_lightning.geometry.cameras import coarse_pixels, rays_through_pixels
from nerf_lightning.geometry.frames import unit_of
from nerf_lightning.geometry.ndc import LEAST_FORWARD
from nerf_lightning.geometry.paths.base import CameraPath, frame_of
from nerf_lightning.models.levels import RadianceModel
from nerf_lightning.models.pictures import Picture, render_picture
from nerf_lightning.types import Background, Cameras

FORMATS = ("video", "frames")

log = logging.getLogger(__name__)


def film(
    model: RadianceModel,
    scene: SceneRecord,
    path: CameraPath,
    background: Background,
    tile_points: int,
    folder: Path,
    form: Literal["video", "frames"] = "video",
) -> list[Path]:
    """Write `video.mp4` and `depth.mp4` (or folders of frames of these names) and return where they are.

    Depth is in the user's units along the ray, coloured over the range of what is seen on the whole path (its outer
    1 % at each end left out), with its scale beside it.
    """
    if form not in FORMATS:
        raise InputError(f"format={form}: choose video (mp4) or frames (PNG files).")
    # Rendered once and kept: the scale of the depth is known at the end only.
    pictures = ranks.in_turn(list(render_path(model, scene, path, background, tile_points)))
    unit = unit_of(scene.to_user)
    seen = unit * torch.cat([picture.depth[picture.opacity > 0.5].flatten() for picture in pictures])
    near, far = unit * float(scene.near.min()), unit * float(scene.far.max())
    if seen.numel():
        near, far = (float(value) for value in torch.quantile(_thinned(seen), torch.tensor([0.01, 0.99])))
    color = [to_bytes(picture.rgb) for picture in pictures]
    depth = [depth_picture(unit * picture.depth, near, far, picture.opacity) for picture in pictures]
    return [
        _write(folder, "video", color, path.fps, form),
        _write(folder, "depth", depth, path.fps, form),
    ]


def render_path(
    model: RadianceModel, scene: SceneRecord, path: CameraPath, background: Background, tile_points: int
) -> Iterator[Picture]:
    """Render this process's pictures of the path; near and far are the widest of the photographs."""
    cameras = path.cameras(frame_of(scene.cameras, scene.aabb))
    count = cameras.c2w.shape[0]
    if scene.cameras.ndc is not None:
        lost = int((~in_front_of_near_plane(cameras)).sum())
        if lost:
            log.warning(
                "%d of %d cameras of the path look aside or stand among the content, where the forward-facing capture "
                "%s has nothing to show: their pictures mean nothing. Use path=spiral.",
                lost,
                count,
                scene.name,
            )
        cameras = replace(cameras, ndc=scene.cameras.ndc[:1].expand(count, 2))
    near = scene.near.min().expand(count)
    far = scene.far.max().expand(count)
    mine = ranks.every_other(range(count))
    for view in track(mine, description="filming", transient=True, console=stderr_console()):
        yield render_picture(model, cameras, view, near, far, background, tile_points)


def in_front_of_near_plane(cameras: Cameras) -> Bool[Tensor, "views"]:
    """Tell which cameras normalised device coordinates can render: before the plane z = -1, and looking along -z."""
    zeros = torch.zeros(len(cameras.c2w))
    rays = rays_through_pixels(cameras, coarse_pixels(cameras), zeros, zeros)
    return (cameras.c2w[:, 2, 3] > -1.0) & (rays.directions[..., 2] < -LEAST_FORWARD).all(dim=-1)


def _write(folder: Path, name: str, frames: list[UInt8[Tensor, "h w 3"]], fps: int, form: str) -> Path:
    target = folder / (name if form == "frames" else f"{name}.mp4")
    if ranks.is_first():
        if form == "frames":
            write_frames(target, frames)
        else:
            write_video(target, frames, fps, len(frames))
    return target


def _thinned(values: Tensor, most: int = 1_000_000) -> Tensor:
    # torch.quantile takes at most 16 million values.
    return values[:: max(1, values.numel() // most)]
