"""Film models along a camera path: color, depth and more, as videos or frames, if a frame fits into memory.

Names of films: FILMS in `panels.py`; their endings: FILES in `settings.py`.
"""

import hashlib
import json
import logging
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import UInt8
from torch import Tensor

from nerf_lightning.compute import ranks
from nerf_lightning.compute.machine import require_memory
from nerf_lightning.compute.ranks import processes_here
from nerf_lightning.messages.console import tracked
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.world_frame import told_length
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.encoding import CODECS, require_encoder
from nerf_lightning.video.exr import exr_channels, require_openexr, save_exr
from nerf_lightning.video.frames import FilmFrames, Range
from nerf_lightning.video.panels import FILMS, channel_picture, film_pictures, panel
from nerf_lightning.video.paths.base import CameraPath
from nerf_lightning.video.settings import ENDINGS, FilmSettings
from nerf_lightning.video.shots import Shot, Subject, depth_range, make_shots
from nerf_lightning.visualization.pictures import save_png, straight_colors

log = logging.getLogger(__name__)


def film(
    subjects: list[Subject], path: CameraPath, tile_points: int, folder: Path, settings: FilmSettings | None = None
) -> list[Path]:
    """Write the films (`video.mp4`, `depth.mp4`, or folders of frames of these names) and return their paths.

    An interrupted film continues with its missing frames. Depth is along the ray, in meters if the capture's unit is
    known and else in its own, colored over the range of what is seen on the whole path, with its scale in a corner.
    Several models of one capture are shown side by side. Without settings, color and depth are filmed as videos.

    Raises:
        InputError: what is requested cannot be filmed or written; finished frames are kept.
    """
    settings = settings or FilmSettings()
    _check(subjects, settings)
    if settings.alpha:
        subjects = [replace(subject, background="black") for subject in subjects]
    shots = make_shots(subjects, path, tile_points, settings)
    require_room(shots[0].cameras, settings, len(subjects))
    for name in [name for name in settings.outputs if name not in FILMS]:
        channel_picture(name, shots[0].picture(0))  # or raises that there is none, before anything is written
    first = shots[0].subject.scene
    films = ["mosaic"] if settings.mosaic else [FILMS.get(name, name) for name in settings.outputs]
    if settings.form == "exr":
        films = ["exr"]  # all in one file
    frames = FilmFrames(folder, films, len(shots[0].cameras.c2w), settings.form, [FILMS["rgb"]] * settings.alpha)
    try:
        # Only the first process looks, before any of them writes.
        missing, depth_limits = ranks.from_first(
            lambda: frames.open(_fingerprint(shots, settings), lambda: depth_range(shots))
        )
        if "depth" in settings.outputs and ranks.is_first():
            log.info("depth is in %s, mostly from %.3g to %.3g", told_length(first)[1], *depth_limits)
        for number in tracked(ranks.every_other(missing), "filming"):
            if settings.form == "exr":
                view = shots[0].picture(number)
                depth = shots[0].z_depth(number, view) if "depth" in settings.outputs else None
                channels = exr_channels(view, depth, "rgb" in settings.outputs, settings.alpha)
                frames.save("exr", number, partial(save_exr, channels=channels, unit=told_length(first)[1]))
            else:
                for name, picture in _frame(shots, settings, number, depth_limits).items():
                    frames.save(name, number, partial(save_png, picture=picture))
        ranks.gather(None)  # all frames are there
        if ranks.is_first():
            frames.finish(path.fps)
    finally:
        frames.close()
    return frames.results()


def _frame(
    shots: list[Shot], settings: FilmSettings, number: int, depth_limits: Range
) -> dict[str, UInt8[Tensor, "_ _ _"]]:
    panels = []
    for shot in shots:
        picture = shot.picture(number)
        normals = shot.normals(number, picture) if "normals" in settings.outputs else None
        panels.append({name: panel(name, picture, depth_limits, shot.unit, normals) for name in settings.outputs})
    pictures = film_pictures(panels, [shot.subject.label for shot in shots], settings.mosaic)
    if settings.alpha:
        pictures[FILMS["rgb"]] = straight_colors(picture.rgb, picture.opacity)
    return pictures


def _check(subjects: list[Subject], settings: FilmSettings) -> None:
    if ENDINGS[settings.form] in CODECS:
        require_encoder(ENDINGS[settings.form])
    if settings.form == "exr":
        require_openexr()
    if (settings.alpha or settings.form == "exr") and len(subjects) > 1:
        raise InputError("alpha=true and format=exr take one checkpoint: several are shown side by side on white.")
    for subject in subjects:
        name = f" ({subject.label})" if len(subjects) > 1 else ""
        if "levels" in settings.outputs and subject.model.first_picture is None:
            raise InputError(
                f"outputs: this model{name} renders one level, and levels shows how two differ, as in model=nerf. "
                "Leave out levels."
            )
        if settings.crop is not None and subject.background == "none" and not settings.alpha:
            raise InputError(
                f"crop: this model{name} has no background to be seen around the box. Add background=white, "
                "background=black, or alpha=true with another format."
            )


def _fingerprint(shots: list[Shot], settings: FilmSettings) -> str:
    """Return a fingerprint of a film: the weights, the cameras, and all settings that decide what is seen."""
    digest = hashlib.sha256(json.dumps(asdict(settings), sort_keys=True).encode())
    for shot in shots:
        digest.update(f"{shot.subject.label} {shot.subject.background} {shot.unit}".encode())
        cameras = shot.cameras
        tensors = [cameras.c2w, cameras.focal, cameras.width, cameras.height, shot.near, shot.far]
        tensors += [] if shot.seen_from is None else [shot.seen_from.c2w]
        for tensor in (*tensors, *shot.subject.model.state_dict().values()):
            flat = tensor.detach().cpu().flatten().clone(memory_format=torch.contiguous_format)
            digest.update(flat.view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()[:16]


PICTURE = 40  # Bytes per pixel, measured on the CPU, of the picture rendered.
SURFACE = 80  # If the surface is used, too: its points and normals, or the channels of an EXR.
PANEL = 16  # What is shown: a panel, its caption and its place in the frame.


def bytes_per_pixel(settings: FilmSettings, num_models: int) -> int:
    """Return the memory of a frame per pixel of a panel; models are rendered one after another."""
    surface = SURFACE if "normals" in settings.outputs or settings.form == "exr" else 0
    return PICTURE + surface + PANEL * len(settings.outputs) * num_models


def require_room(cameras: Cameras, settings: FilmSettings, num_models: int = 1) -> None:
    """Refuse frames (of cameras of one size) that take more memory than is available, in all processes."""
    width, height = int(cameras.width[0]), int(cameras.height[0])
    together = processes_here() if ranks.world_size() > 1 else 1
    each = together * bytes_per_pixel(settings, num_models)

    def tall(wide: int) -> int:
        return max(1, round(height * wide / width))

    ranks.from_first(
        lambda: require_memory(
            f"A frame of {width} x {height} pixels is rendered as a whole",
            width,
            lambda wide: each * wide * tall(wide),
            lambda wide: f"path.width={wide} path.height={tall(wide)}",
        )
    )
