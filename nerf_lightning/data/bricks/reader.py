"""The embedded scene: a fire engine of bricks and the cameras around it, rendered on first use and cached."""

import math
import multiprocessing
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from rich.progress import Progress
from torch import Tensor

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.console import ProgressLines, progress_bar
from nerf_lightning.data.bricks.cache import Rendered, cache_file, cached
from nerf_lightning.data.bricks.family import Model, model
from nerf_lightning.data.bricks.solids import Solids
from nerf_lightning.data.bricks.tracer import Pinhole, Tracer
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.errors import InputError
from nerf_lightning.files.folders import default_folder
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, pinhole_cameras
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore, Scene, Truth

RENDER_VERSION = 1
"""Part of the cache's key: raise it whenever a pixel changes."""
FAMILY_VERSION = 1
"""The same for the models beside the fire engine: raise it whenever one of them changes."""
CHUNK = 3_000_000
"""Rays that one thread takes at a time: enough to share the search for shadows, few enough for memory."""
MOST_THREADS = 4
"""Each takes about half a gigabyte."""
MARGIN = 0.02
"""Room between the model and the box handed out, in world units."""


class BricksReader(Reader):
    """Render the embedded scene, with exact depth and normals.

    Args:
        variant: which model of the family: 0 is the fire engine; each other number is a vehicle or a tower of its own,
            in its own colours and light.
        resolution: width and height of every picture in pixels.
        num_train: number of training views, spread over the upper hemisphere.
        num_val: number of validation views, in the gaps between the training views.
        num_test: number of test views, on an orbit.
        near: distance from a camera at which content may begin; the model lies between 2.7 and 5.4.
        far: distance at which content ends.
        gain: every colour c (an sRGB code between 0 and 1) is photographed as gain * c^gamma, as a camera with other
            settings would show it.
        gamma: see gain.
        background: what the transparent pixels are blended with.
        cache_dir: folder of the rendered pictures; by default in the user's cache folder
            (`$NERF_LIGHTNING_CACHE`, `$XDG_CACHE_HOME` or ~/.cache).
        name: the scene's name in reports.
    """

    def __init__(
        self,
        variant: int = 0,
        resolution: int = 128,
        num_train: int = 100,
        num_val: int = 20,
        num_test: int = 25,
        near: float = 2.0,
        far: float = 6.0,
        gain: float = 1.0,
        gamma: float = 1.0,
        background: Background = "white",
        cache_dir: str | None = None,
        name: str = "bricks",
    ) -> None:
        self.variant = variant
        self.resolution = resolution
        self.counts = {"train": num_train, "val": num_val, "test": num_test}
        self.near = near
        self.far = far
        self.gain, self.gamma = gain, gamma
        self.background = background
        self.cache_dir = cache_dir
        self.name = name

    def read(self) -> Scene:
        """Return all views: train, then val, then test.

        Raises:
            InputError: an argument is out of range.
        """
        self._check()
        views = sum(self.counts.values())
        cameras = bricks_cameras(**self.counts, resolution=self.resolution)
        folder = Path(self.cache_dir).expanduser() if self.cache_dir else default_folder("bricks")
        settings = {"version": RENDER_VERSION, "resolution": self.resolution, **self.counts}
        if self.variant:
            settings |= {"variant": self.variant, "family": FAMILY_VERSION}
        pixels, shown = views * self.resolution**2, model(self.variant)
        rendered = cached(cache_file(folder, settings), pixels, lambda: render(cameras, shown))
        splits, names = self._splits()
        return Scene(
            name=self.name,
            cameras=cameras,
            pixels=PixelStore(
                rgba=self._photographed(torch.from_numpy(rendered.rgba)),
                offset=torch.arange(views) * self.resolution**2,
                width=cameras.width,
                height=cameras.height,
                has_transparency=bool((rendered.rgba[:, 3] < 255).any()),
            ),
            near=torch.full((views,), float(self.near)),
            far=torch.full((views,), float(self.far)),
            aabb=torch.from_numpy(model_box(shown)),
            splits=splits,
            view_names=names,
            background=self.background,
            to_user=torch.eye(4),
            protocol=self._protocol(),
            truth=Truth(torch.from_numpy(rendered.depth), torch.from_numpy(rendered.normals)),
        )

    def _photographed(self, rgba: UInt8[Tensor, "pixels 4"]) -> UInt8[Tensor, "pixels 4"]:
        """Return the pictures as a camera with this gain and gamma shows them; alpha stays."""
        if self.gain == self.gamma == 1.0:
            return rgba
        shown = (255.0 * self.gain * (torch.arange(256) / 255.0) ** self.gamma).round().clamp(max=255).to(torch.uint8)
        return torch.cat([shown[rgba[:, :3].long()], rgba[:, 3:]], dim=1)

    def _protocol(self) -> dict[str, str]:
        protocol = {"filter": "4x4 supersampling", "renderer": f"bricks {RENDER_VERSION}"}
        if (self.gain, self.gamma) != (1.0, 1.0):
            protocol["colors of the photographs"] = f"{self.gain:g} c^{self.gamma:g}"
        return protocol

    def _splits(self) -> tuple[dict[str, tuple[int, ...]], tuple[str, ...]]:
        splits, names, first = {}, [], 0
        for split, count in self.counts.items():
            splits[split] = tuple(range(first, first + count))
            names += [f"{split}_{i:03d}" for i in range(count)]
            first += count
        return splits, tuple(names)

    def _check(self) -> None:
        if self.variant < 0:
            raise InputError(
                f"The bricks scene has no scene.variant={self.variant}: 0 is the fire engine; 1, 2, 3, ... are others."
            )
        if self.resolution < 1:
            raise InputError(
                f"The bricks scene cannot be rendered at scene.resolution={self.resolution}: give a width in pixels, "
                "1 or more (128 is the default)."
            )
        for split, least in (("train", 1), ("val", 0), ("test", 0)):
            if self.counts[split] < least:
                raise InputError(
                    f"The bricks scene cannot have scene.num_{split}={self.counts[split]} views: give {least} or more."
                )
        if not 0 <= self.near < self.far:
            raise InputError(
                f"The bricks scene was given scene.near={self.near} and scene.far={self.far}: near must be 0 or more "
                "and less than far (2 and 6 hold the model)."
            )
        if not (self.gain > 0 and self.gamma > 0):
            raise InputError(
                f"The bricks scene was given scene.gain={self.gain} and scene.gamma={self.gamma}: give numbers above 0."
            )
        if self.background not in get_args(Background):
            raise InputError(
                f"The bricks scene knows no scene.background={self.background}: choose one of "
                f"{', '.join(get_args(Background))}."
            )


def model_box(shown: Model) -> Float[ndarray, "2 3"]:
    """Return the lower and upper corner of a box that holds a model with a little room."""
    corners = Solids.of(shown.parts).corners().reshape(-1, 3)
    return np.stack([corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN]).astype(np.float32)


def render(cameras: Cameras, shown: Model) -> Rendered:
    """Render every view, on a few cores, with a progress bar on stderr."""
    tracer = Tracer(shown.parts, shown.light)
    resolution = int(cameras.width[0])
    views = [
        Pinhole(c2w.double().numpy(), float(focal[0]), resolution)
        for c2w, focal in zip(cameras.c2w, cameras.focal, strict=True)
    ]
    step = max(1, CHUNK // (16 * resolution**2))
    chunks = [views[i : i + step] for i in range(0, len(views), step)]
    parts = []
    with _progress() as progress, ThreadPoolExecutor(min(MOST_THREADS, num_cores())) as pool:
        task, lines = progress.add_task("Rendering the bricks scene (once)", total=len(views)), ProgressLines()
        for chunk, part in zip(chunks, pool.map(lambda chunk: _render_chunk(tracer, chunk), chunks), strict=True):
            parts.append(part)
            progress.advance(task, len(chunk))
            lines("rendering the bricks scene (once)", len(parts) / len(chunks))
    return Rendered(*(np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])))


def _render_chunk(tracer: Tracer, views: list[Pinhole]) -> Rendered:
    geometry = [tracer.geometry(view) for view in views]
    return Rendered(
        rgba=tracer.pictures(views).reshape(-1, 4),
        depth=np.concatenate([depth for depth, _ in geometry]),
        normals=np.concatenate([normals for _, normals in geometry]),
    )


def _progress() -> Progress:
    """One bar per run: not in the workers of a loader, nor on the other ranks."""
    main = multiprocessing.parent_process() is None and os.environ.get("LOCAL_RANK", "0") == "0"
    return progress_bar(shown=main)


DISTANCE = 4.0311
"""From each camera to the origin, as in the Blender scenes."""
FIELD_OF_VIEW = 0.6911112070083618
"""Horizontal, in radians, as in the Blender scenes."""
LOWEST, HIGHEST = 0.05, 0.97
"""Sine of the elevation: above the horizon, short of the pole, where a picture has no upright."""
PLASTIC = 1.32471795724474602596
"""Root of x^3 = x + 1; its powers spread points evenly over a square, however many are taken."""


def bricks_cameras(train: int, val: int, test: int, resolution: int) -> Cameras:
    """Return square views that look at the origin: train first, then val, then test.

    Train and val are successive points of one additive recurrence, so val lies in the gaps of train.
    """
    index = torch.arange(train + val, dtype=torch.float64)
    sphere = _on_sphere((0.5 + index / PLASTIC) % 1, LOWEST + (HIGHEST - LOWEST) * ((0.5 + index / PLASTIC**2) % 1))
    eyes = DISTANCE * torch.cat([sphere, _orbit(test)])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    c2w = look_at(eyes, torch.zeros_like(eyes), up).float()
    return pinhole_cameras(c2w, focal_from_fov(resolution, FIELD_OF_VIEW), resolution, resolution)


def _orbit(num_views: int) -> Float[Tensor, "views 3"]:
    """Once around, rising and sinking twice, between 14 and 46 degrees of elevation."""
    turn = (torch.arange(num_views, dtype=torch.float64) + 0.4) / max(num_views, 1)
    elevation = math.radians(30) + math.radians(16) * torch.sin(4 * math.pi * turn)
    return _on_sphere(turn, elevation.sin())


def _on_sphere(turn: Float[Tensor, "views"], height: Float[Tensor, "views"]) -> Float[Tensor, "views 3"]:
    radius = (1 - height**2).sqrt()
    angle = 2 * math.pi * turn
    return torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=-1)
