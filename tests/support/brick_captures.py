"""Captures of bricks with exact poses, any number of them, of kinds that are easy and hard to examine."""

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import torch

from nerf_lightning.data.bricks.cache import Pictures, cache_file, cached
from nerf_lightning.data.bricks.parts import (
    ALONG_Z,
    BLACK,
    GREY,
    RED,
    SILVER,
    WHITE,
    YELLOW,
    Part,
    ball,
    block,
    fire_engine,
    rod,
)
from nerf_lightning.data.bricks.reader import FIELD_OF_VIEW
from nerf_lightning.data.bricks.shapes import BOX
from nerf_lightning.data.bricks.tracer import Pinhole, Tracer
from nerf_lightning.data.pixels.store import layout
from nerf_lightning.files.folders import default_folder
from nerf_lightning.nerf.geometry.cameras import focal_from_fov, pinhole_cameras
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import PixelStore, Scene

SIZE = 112
"""Pixels of a side: enough for the doctor, and few enough for hundreds of captures."""
UP = torch.tensor([0.0, 0.0, 1.0])


def plain_engine() -> list[Part]:
    """The fire engine, all of one color."""
    dull = replace(WHITE, specular=0.0, mirror=0.0)
    return [replace(part, material=dull) for part in fire_engine()]


def can() -> list[Part]:
    """A drinks can: rings all around, and one and the same label on its two sides."""
    parts = [rod((0.0, 0.0, 0.0), 0.55, 2.0, ALONG_Z, RED)]
    for height, width, material in ((-0.9, 0.1, SILVER), (-0.7, 0.04, WHITE), (0.72, 0.05, WHITE), (0.93, 0.1, SILVER)):
        parts.append(rod((0.0, 0.0, height), 0.555, width, ALONG_Z, material))
    rng = np.random.default_rng(1)
    for _ in range(10):
        angle, height, size = 0.9 * rng.uniform(-1, 1), rng.uniform(-0.5, 0.5), rng.uniform(0.03, 0.13, 2)
        material = (WHITE, YELLOW, BLACK)[rng.integers(3)]
        for turn in (0.0, math.pi):
            c, s = math.cos(angle + turn), math.sin(angle + turn)
            frame = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            parts.append(Part(BOX, (0.015, *map(float, size)), (0.55 * c, 0.55 * s, float(height)), frame, material))
    return parts


def microphone() -> list[Part]:
    """A thin thing on plain ground."""
    return [
        block((-3.0, -3.0, -1.0), (3.0, 3.0, -0.9), GREY),
        rod((0.0, 0.0, -0.86), 0.45, 0.08, ALONG_Z, BLACK),
        rod((0.0, 0.0, -0.1), 0.04, 1.5, ALONG_Z, SILVER),
        rod((0.0, 0.0, 0.6), 0.12, 0.35, ALONG_Z, BLACK),
        ball((0.0, 0.0, 0.85), 0.25, SILVER),
    ]


POOLS: dict[str, tuple[Callable[[], list[Part]], int]] = {
    "engine": (fire_engine, 400), "plain": (plain_engine, 150), "can": (can, 150), "microphone": (microphone, 150),
}  # fmt: skip
"""What is photographed, and from how many places in all."""


@cache
def pool(thing: str) -> Scene:
    """Every photograph of a thing, from random places above the ground that look a little beside it."""
    parts, count = POOLS[thing][0](), POOLS[thing][1]
    random = torch.Generator().manual_seed(len(thing))
    turn, height, away = torch.rand(3, count, generator=random)
    height = 0.08 + 0.8 * height if thing in ("engine", "plain") else 0.1 + 0.4 * height
    around, flat = 2 * math.pi * turn, (1 - height.square()).sqrt()
    eyes = (3.4 + 1.6 * away)[:, None] * torch.stack([flat * around.cos(), flat * around.sin(), height], dim=-1)
    c2w = look_at(eyes, 0.15 * torch.randn(count, 3, generator=random), UP).float()
    cameras = pinhole_cameras(c2w, focal_from_fov(SIZE, FIELD_OF_VIEW), SIZE, SIZE)

    def render() -> Pictures:
        tracer, views = (
            Tracer(parts),
            [Pinhole(pose.double().numpy(), float(cameras.focal[0, 0]), SIZE) for pose in c2w],
        )
        return np.concatenate([tracer.pictures(views[i : i + 10]) for i in range(0, count, 10)]).reshape(-1, 4)

    numbers = [(part.size, part.center, part.frame.tolist(), vars(part.material)) for part in parts]
    version = int.from_bytes(hashlib.sha256(repr(numbers).encode()).digest()[:6])
    file = cache_file(default_folder("bricks"), {"version": version, "size": SIZE, "count": count})
    rgba = torch.from_numpy(cached(file, count * SIZE * SIZE, render))
    return Scene(
        name=thing,
        cameras=cameras,
        pixels=PixelStore(rgba, *layout([(SIZE, SIZE)] * count), has_transparency=True),
        near=torch.full((count,), 1.5),
        far=torch.full((count,), 9.0),
        aabb=torch.tensor([[-1.3] * 3, [1.3] * 3]),
        splits={"train": tuple(range(count)), "val": (), "test": ()},
        view_names=tuple(f"{view:03d}.png" for view in range(count)),
        background="white",
        to_user=torch.eye(4, dtype=torch.float64),
        protocol={},
        truth=None,
        space="contracted" if thing == "microphone" else "bounded",
    )


def of_views(scene: Scene, views: Sequence[int]) -> Scene:
    """Return a scene of some of the views."""
    rgba = torch.cat([scene.pixels.view(view).reshape(-1, 4) for view in views])
    sizes = [(int(scene.pixels.width[view]), int(scene.pixels.height[view])) for view in views]
    chosen = torch.tensor(views)
    return replace(
        scene,
        cameras=scene.cameras[chosen],
        pixels=replace(scene.pixels, rgba=rgba, **dict(zip(("offset", "width", "height"), layout(sizes), strict=True))),
        near=scene.near[chosen],
        far=scene.far[chosen],
        splits={"train": tuple(range(len(views))), "val": (), "test": ()},
        view_names=tuple(f"{number:03d}.png" for number in range(len(views))),
    )


def _some(thing: str, count: int, random: torch.Generator) -> Scene:
    scene = pool(thing)
    return of_views(scene, torch.randperm(len(scene.view_names), generator=random)[:count].tolist())


def few(random: torch.Generator) -> Scene:
    """Five to twelve neighbors."""
    scene = pool("engine")
    towards = torch.nn.functional.normalize(scene.cameras.c2w[:, :, 3], dim=-1)
    middle = towards[int(torch.randint(len(towards), (), generator=random))]
    count = int(torch.randint(5, 13, (), generator=random))
    return of_views(scene, (towards @ middle).topk(count).indices.tolist())


def turned(random: torch.Generator) -> Scene:
    """The world turned, scaled and moved."""
    scene = _some("engine", 24, random)
    rotation = torch.linalg.qr(torch.randn(3, 3, generator=random)).Q
    rotation = rotation * torch.linalg.det(rotation)
    unit = 10 ** (2 * float(torch.rand((), generator=random)) - 1)
    c2w = rotation @ scene.cameras.c2w
    c2w[:, :, 3] = unit * (c2w[:, :, 3] + torch.randn(3, generator=random))
    cameras = replace(scene.cameras, c2w=c2w)
    return replace(scene, cameras=cameras, near=unit * scene.near, far=unit * scene.far, space="contracted")


def cropped(random: torch.Generator) -> Scene:
    """Of each photograph another part, so that the principal point lies elsewhere in each."""
    scene = _some("engine", 24, random)
    side = int(SIZE * (0.6 + 0.3 * float(torch.rand((), generator=random))))
    count = len(scene.view_names)
    corner = torch.randint(0, SIZE - side + 1, (count, 2), generator=random)
    views = [scene.pixels.view(view)[y : y + side, x : x + side] for view, (x, y) in enumerate(corner.tolist())]
    store = PixelStore(torch.cat([view.reshape(-1, 4) for view in views]), *layout([(side, side)] * count), True)
    cameras = replace(scene.cameras, center=scene.cameras.center - corner, width=store.width, height=store.height)
    return replace(scene, cameras=cameras, pixels=store)


def noisy(random: torch.Generator) -> Scene:
    """Opaque, each on a background of another color, with the noise of a dark room."""
    scene = _some("engine", 24, random)
    rgba = scene.pixels.rgba.view(24, -1, 4).float()
    alpha, behind = rgba[..., 3:] / 255, 255 * torch.rand(24, 1, 3, generator=random)
    noise = (4 + 8 * torch.rand((), generator=random)) * torch.randn(*rgba.shape[:2], 3, generator=random)
    rgb = (alpha * rgba[..., :3] + (1 - alpha) * behind + noise).clamp(0, 255)
    rgba = torch.cat([rgb, torch.full_like(alpha, 255)], dim=-1).to(torch.uint8).reshape(-1, 4)
    pixels = replace(scene.pixels, rgba=rgba, has_transparency=False)
    return replace(scene, pixels=pixels, background="none", space="contracted")


KINDS: dict[str, Callable[[torch.Generator], Scene]] = {
    "few views": few,
    "many views": lambda random: _some("engine", 48, random),
    "one color": lambda random: _some("plain", 28, random),
    "turned": turned,
    "cropped": cropped,
    "noisy": noisy,
    "can": lambda random: _some("can", 28, random),
    "microphone": lambda random: _some("microphone", 28, random),
}


def brick_capture(kind: str, seed: int) -> Scene:
    """Return a capture whose poses are exact."""
    number = list(KINDS).index(kind)
    return replace(KINDS[kind](torch.Generator().manual_seed(len(KINDS) * seed + number)), name=f"{kind} {seed}")
