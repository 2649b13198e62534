"""Places built of bricks, with exact poses and distances: around a heap, through a corridor, outward from a ring."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from support.posed_captures import READERS, Known, write_colmap, write_transforms

from nerf_lightning.data.bricks.light import DAY
from nerf_lightning.data.bricks.parts import GREY, Material, Part, block
from nerf_lightning.data.bricks.tracer import Pinhole, Tracer
from nerf_lightning.nerf.geometry.poses import look_at
from nerf_lightning.nerf.types.scene import Scene

SIZE, FOCAL = 96, 86.0
"""Pixels of a side and of the focal length: 58 degrees across."""
SIDES, MIDDLE = 3, 4
"""SIDES x SIDES rays go through a pixel, and the one of this number through its center."""
NOTHING = (205, 215, 230)
"""What rays that meet no brick show."""
LEAST_AHEAD = 0.01
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
FLOOR = block((-30.0, -30.0, -0.2), (30.0, 30.0, 0.0), GREY)


@dataclass(frozen=True)
class Place:
    """What was photographed, and from where; lengths in meters, z up."""

    c2w: np.ndarray
    pictures: np.ndarray
    """(views, SIZE, SIZE, 3), uint8."""
    distance: np.ndarray
    """(views, SIZE^2) to the bricks along the rays through the pixels' centers; inf where there is none."""

    def with_cameras_moved(self, views: list[int], times: float) -> "Place":
        """Return the place with poses so many times as far from the origin, from which no distance is known."""
        c2w, distance = self.c2w.copy(), self.distance.copy()
        c2w[views, :, 3] *= times
        distance[views] = np.inf
        return replace(self, c2w=c2w, distance=distance)

    def points(self, of_view: int = 60) -> np.ndarray:
        """Return points on the bricks that the pictures show, as a sparse reconstruction has them."""
        rng, found = np.random.default_rng(5), []
        for pose, distance in zip(self.c2w, self.distance, strict=True):
            pixels = rng.permutation(np.flatnonzero(np.isfinite(distance)))[:of_view]
            directions = Pinhole(pose, FOCAL, SIZE).directions(pixels % SIZE + 0.5, pixels // SIZE + 0.5)
            found.append(pose[:, 3] + distance[pixels, None] * directions.T)
        return np.concatenate(found)

    def read(self, kind: str, root: Path, unit: float = 1.0, origin: tuple[float, float, float] = (0, 0, 0)) -> Scene:
        """Write the place in a format, in units of `unit` meters, and read it as any capture."""
        names = tuple(f"{number:03d}.png" for number in range(len(self.c2w)))
        known = Known(self.c2w, names, (SIZE, SIZE), (FOCAL, FOCAL), (SIZE / 2, SIZE / 2), self.points())
        known = known.moved(1.0 / unit, np.eye(3), np.array(origin))
        {"colmap": write_colmap, "transforms": write_transforms}[kind](root, known)
        for name, picture in zip(names, self.pictures, strict=True):
            Image.fromarray(picture).save(root / "images" / name)
        return READERS[kind](root=str(root), cache_dir=str(root.parent / "cache")).read()


@cache
def heap(around: float = 360.0, views: int = 18, seed: int = 0) -> Place:
    """Photographs on an arc of so many degrees around a heap of bricks, with others far behind it."""
    turn, number = _turns(around, views), torch.arange(views, dtype=torch.float64)
    eyes = torch.stack([4.0 * turn.cos(), 4.0 * turn.sin(), 1.6 + 0.5 * (2.3 * number).sin()], dim=-1)
    middle = torch.tensor([0.0, 0.0, 0.5], dtype=torch.float64).expand_as(eyes)
    rng = np.random.default_rng(seed)
    bricks = [*_around(rng, 60, (0.0, 1.1), 1.0), *_around(rng, 60, (7.0, 9.0), 3.0)]
    return _photographed(bricks, look_at(eyes, middle, UP))


@cache
def outward_ring(radius: float, views: int = 18, seed: int = 0) -> Place:
    """Photographs that look outward from a ring, with bricks around."""
    turn = _turns(360.0, views)
    ahead = torch.stack([turn.cos(), turn.sin(), 0.1 * (3 * turn).sin()], dim=-1)
    eyes = radius * ahead + torch.tensor([0.0, 0.0, 1.5], dtype=torch.float64)
    bricks = _around(np.random.default_rng(seed), 220, (radius + 1.5, radius + 3.0), 3.0)
    return _photographed(bricks, look_at(eyes, eyes + ahead, UP))


@cache
def corridor(bend: float = 0.0, glance: float = 0.0, views: int = 18, seed: int = 0) -> Place:
    """Photographs of a walk ahead between two walls of bricks, to the third that ends it.

    Args:
        bend: by how many degrees the corridor turns in all.
        glance: how many degrees the camera looks aside, to one side and the other.
        views: number of photographs, one every 0.4 m.
        seed: of the bricks.
    """
    rng, length = np.random.default_rng(seed), 0.4 * views + 4.0

    def place(along: float, aside: float) -> tuple[float, float, float]:
        """Return x, y and the direction of a place, in radians."""
        turn = np.radians(bend) * along / length
        x, y = along * np.sinc(turn / np.pi), along * np.sinc(turn / 2 / np.pi) * np.sin(turn / 2)
        return x - aside * np.sin(turn), y + aside * np.cos(turn), turn

    sides = [place(rng.uniform(-0.5, length), side * rng.uniform(1.1, 1.4)) for side in (-1.0, 1.0) for _ in range(90)]
    ends = [place(length, rng.uniform(-1.2, 1.2)) for _ in range(30)]
    bricks = [_brick(rng, x, y, rng.uniform(0.0, 2.6)) for x, y, _ in (*sides, *ends)]
    eyes, ahead = [], []
    for number in range(views):
        x, y, turn = place(0.4 * number, 0.1 * np.sin(1.3 * number))
        turn += np.radians(glance) * np.sin(1.1 * number)
        eyes.append([x, y, 1.4 + 0.05 * np.sin(2.1 * number)])
        ahead.append([np.cos(turn), np.sin(turn), 0.03 * np.sin(number)])
    start = torch.tensor(eyes, dtype=torch.float64)
    return _photographed(bricks, look_at(start, start + torch.tensor(ahead, dtype=torch.float64), UP))


class _Among(Pinhole):
    """A view that has bricks beside and behind it."""

    def rectangles(self, corners: np.ndarray) -> np.ndarray:
        """Return the whole picture for a brick beside the camera, and none of it for one behind."""
        upper, lower = super().rectangles(corners)
        behind = (corners - self.c2w[:, 3]) @ self.c2w[:, 2] > -LEAST_AHEAD
        upper[behind.any(axis=1)], lower[behind.any(axis=1)] = 0, self.resolution
        lower[behind.all(axis=1)] = -1
        return np.stack([upper, lower])


def _photographed(bricks: list[Part], c2w: torch.Tensor) -> Place:
    """Return bricks on a floor as they are seen from some poses, without shadows."""
    parts, poses, pixels = [*bricks, FLOOR], c2w.numpy(), SIZE**2
    tracer, colors = Tracer(parts), np.array([part.material.color for part in parts])
    pictures, distances = [], np.full((len(poses), pixels), np.inf)
    for pose, distance in zip(poses, distances, strict=True):
        found = tracer.find(_Among(pose, FOCAL, SIZE), SIDES, tracer.fast)
        light = 0.65 + 0.35 * np.abs(DAY.key @ tracer.fast.normals(found.points, found.part))
        missed = 1 - np.bincount(found.pixel, minlength=pixels)[:, None] / SIDES**2
        rgb = [np.bincount(found.pixel, light * level, pixels) / SIDES**2 for level in colors[found.part].T]
        shown = 255 * np.stack(rgb, axis=-1) + missed * np.array(NOTHING)
        pictures.append(np.rint(shown).astype(np.uint8).reshape(SIZE, SIZE, 3))
        centers = (found.ray == MIDDLE) & (found.part < len(bricks))
        distance[found.pixel[centers]] = found.depth[centers]
    return Place(poses, np.stack(pictures), distances)


def _turns(degrees: float, count: int) -> torch.Tensor:
    return torch.deg2rad(torch.arange(count, dtype=torch.float64) * degrees / count)


def _around(rng: np.random.Generator, count: int, away: tuple[float, float], height: float) -> list[Part]:
    turns, radii = rng.uniform(0, 2 * np.pi, count), rng.uniform(*away, count)
    return [
        _brick(rng, r * np.cos(turn), r * np.sin(turn), z)
        for turn, r, z in zip(turns, radii, rng.uniform(0, height, count), strict=True)
    ]


def _brick(rng: np.random.Generator, x: float, y: float, z: float) -> Part:
    """Return a brick of any size and color that stands around (x, y) at the height z."""
    a, b, c = map(float, rng.uniform(0.15, 0.5, 3))
    red, green, blue = map(float, rng.uniform(0.1, 0.95, 3))
    return block((x - a / 2, y - b / 2, z), (x + a / 2, y + b / 2, z + c), Material((red, green, blue)))
