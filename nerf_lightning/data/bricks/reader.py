"""The built-in scene: a fire engine of bricks and the cameras around it, rendered on first use and cached.

The numbers of views and pixels: `conf/scene/bricks.yaml`. The fire engine: `parts.py`.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from nerf_lightning.compute.cores import num_cores
from nerf_lightning.data.bricks.cache import Pictures, cache_file, cached
from nerf_lightning.data.bricks.light import DAY, Model
from nerf_lightning.data.bricks.parts import fire_engine
from nerf_lightning.data.bricks.solids import Solids
from nerf_lightning.data.bricks.tracer import Pinhole, Tracer
from nerf_lightning.data.captures.checks import known_background
from nerf_lightning.data.readers.base import Reader
from nerf_lightning.files.folders import default_folder
from nerf_lightning.messages.console import tracked
from nerf_lightning.messages.errors import InputError
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, pinhole_cameras
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Background, Cameras, PixelStore, Scene, Truth

RENDER_VERSION = 1
"""Part of the cache's key: raise it whenever a pixel changes."""
CHUNK = 3_000_000
"""Rays per thread at a time: enough to share the search for shadows, few enough for memory."""
MOST_THREADS = 4
"""Each takes about half a gigabyte."""
PACKAGED = {"version": RENDER_VERSION, "resolution": 128, "train": 100, "val": 20, "test": 25}
"""The settings whose pictures are packaged, which saves half a minute: in a grid with COLUMNS per row."""
COLUMNS = 5
MARGIN = 0.02
"""Margin between the model and its bounding box, in world units."""
DISTANCE = 4.0311
"""From each camera to the origin, as in the Blender scenes."""
FIELD_OF_VIEW = 0.6911112070083618
"""Horizontal, in radians, as in the Blender scenes."""
LOWEST, HIGHEST = 0.05, 0.97
"""Sine of the elevation: above the horizon, and below the pole, where up is undefined."""
PLASTIC = 1.32471795724474602596
"""Root of x^3 = x + 1; its powers spread any number of points evenly over a square."""


@dataclass
class BricksReader(Reader):
    """Render the built-in scene, with exact depth and normals.

    Args:
        resolution: width and height of every image in pixels.
        num_train: number of training views, spread over the upper hemisphere.
        num_val: number of validation views, in the gaps between the training views.
        num_test: number of test views, on an orbit.
        near: distance from a camera at which content begins; the model is between 2.7 and 5.4.
        far: distance at which content ends.
        background: the background of transparent pixels.
        cache_dir: the folder of the rendered images; by default in the user's cache folder (`$NERF_LIGHTNING_CACHE`,
            `$XDG_CACHE_HOME` or ~/.cache).
        name: the scene's name in reports.
    """

    resolution: int = 128
    num_train: int = 100
    num_val: int = 20
    num_test: int = 25
    near: float = 2.0
    far: float = 6.0
    background: Background = "white"
    cache_dir: str | None = None
    name: str = "bricks"

    def model(self) -> Model:
        """Return what is rendered."""
        return Model(fire_engine(), DAY)

    def model_key(self) -> dict[str, int]:
        """Return what distinguishes this model from others in the cache."""
        return {}

    def read(self) -> Scene:
        """Return all views: train, then val, then test.

        Raises:
            InputError: an argument is out of range.
        """
        self._check()
        counts = {"train": self.num_train, "val": self.num_val, "test": self.num_test}
        views, cameras = sum(counts.values()), bricks_cameras(**counts, resolution=self.resolution)
        folder = Path(self.cache_dir).expanduser() if self.cache_dir else default_folder("bricks")
        key = {"version": RENDER_VERSION, "resolution": self.resolution, **counts, **self.model_key()}
        pixels, model = views * self.resolution**2, self.model()
        if key == PACKAGED:
            rgba = packaged_pictures()
        else:
            rgba = cached(cache_file(folder, key), pixels, lambda: render(cameras, model))
        corners = Solids.of(model.parts).corners().reshape(-1, 3)
        box = np.stack([corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN]).astype(np.float32)
        starts = dict(zip(counts, accumulate(counts.values(), initial=0), strict=False))
        return Scene(
            name=self.name,
            cameras=cameras,
            pixels=PixelStore(
                rgba=torch.from_numpy(rgba),
                offset=torch.arange(views) * self.resolution**2,
                width=cameras.width,
                height=cameras.height,
                has_transparency=bool((rgba[:, 3] < 255).any()),
            ),
            near=torch.full((views,), float(self.near)),
            far=torch.full((views,), float(self.far)),
            aabb=torch.from_numpy(box),
            splits={split: tuple(range(starts[split], starts[split] + n)) for split, n in counts.items()},
            view_names=tuple(f"{split}_{i:03d}" for split, n in counts.items() for i in range(n)),
            background=self.background,
            to_user=torch.eye(4, dtype=torch.float64),
            protocol={"filter": "4x4 supersampling", "renderer": f"bricks {RENDER_VERSION}"},
            truth=ExactGeometry(cameras, model),
        )

    def _check(self) -> None:
        for name, least in (("resolution", 1), ("num_train", 1), ("num_val", 0), ("num_test", 0)):
            if (value := getattr(self, name)) < least:
                raise InputError(f"The bricks scene cannot have scene.{name}={value}: give {least} or more.")
        if not 0 <= self.near < self.far:
            raise InputError(
                f"The bricks scene was given scene.near={self.near} and scene.far={self.far}: near must be 0 or more "
                "and less than far (2 and 6 hold the model)."
            )
        known_background(self.background)


@dataclass(frozen=True)
class ExactGeometry:
    """Depth and normals of a view, traced on demand."""

    cameras: Cameras
    model: Model

    def __call__(self, view: int) -> Truth:
        """Return depth and normals at the centers of a view's pixels."""
        depth, normals = Tracer(self.model.parts, self.model.light).geometry(_pinhole(self.cameras, view))
        return Truth(torch.from_numpy(depth), torch.from_numpy(normals))


def packaged_pictures() -> Pictures:
    """Return the pictures of PACKAGED, bit for bit as `render` renders them."""
    size = PACKAGED["resolution"]
    with Image.open(Path(__file__).with_name("pictures.webp")) as sheet:
        rows = np.asarray(sheet.convert("RGBA")).reshape(-1, size, COLUMNS, size, 4)
    return rows.transpose(0, 2, 1, 3, 4).reshape(-1, 4)


def render(cameras: Cameras, model: Model) -> Pictures:
    """Render every view, on a few cores, with a progress bar on stderr."""
    tracer = Tracer(model.parts, model.light)
    views = [_pinhole(cameras, view) for view in range(len(cameras.c2w))]
    step = max(1, CHUNK // (16 * views[0].resolution ** 2))
    chunks = [views[i : i + step] for i in range(0, len(views), step)]
    with ThreadPoolExecutor(min(MOST_THREADS, num_cores())) as pool:
        rendered = pool.map(tracer.pictures, chunks)
        parts = [next(rendered) for _ in tracked(chunks, "rendering the bricks scene (once)")]
    return np.concatenate(parts).reshape(-1, 4)


def _pinhole(cameras: Cameras, view: int) -> Pinhole:
    return Pinhole(cameras.c2w[view].double().numpy(), float(cameras.focal[view, 0]), int(cameras.width[view]))


def bricks_cameras(train: int, val: int, test: int, resolution: int) -> Cameras:
    """Return square views: train first, then val, then test.

    Train and val are successive points of one additive recurrence on the upper hemisphere, so val lies in the gaps of
    train. Test orbits once, rising and falling twice, between 14 and 46 degrees of elevation.
    """
    index = torch.arange(train + val, dtype=torch.float64)
    sphere = _on_sphere((0.5 + index / PLASTIC) % 1, LOWEST + (HIGHEST - LOWEST) * ((0.5 + index / PLASTIC**2) % 1))
    turn = (torch.arange(test, dtype=torch.float64) + 0.4) / max(test, 1)
    elevation = math.radians(30) + math.radians(16) * torch.sin(4 * math.pi * turn)
    eyes = DISTANCE * torch.cat([sphere, _on_sphere(turn, elevation.sin())])
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    c2w = look_at(eyes, torch.zeros_like(eyes), up).float()
    return pinhole_cameras(c2w, focal_from_fov(resolution, FIELD_OF_VIEW), resolution, resolution)


def _on_sphere(turn: Float[Tensor, "views"], height: Float[Tensor, "views"]) -> Float[Tensor, "views 3"]:
    radius, angle = (1 - height**2).sqrt(), 2 * math.pi * turn
    return torch.stack([radius * angle.cos(), radius * angle.sin(), height], dim=-1)
