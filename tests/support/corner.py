"""Photographs of a corner of a room whose three walls are covered with noise, with cameras that are known."""

from functools import cache

import numpy as np
import torch
from PIL import Image

from nerf_lightning.nerf.geometry.poses import look_at

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
WALL = 5.0
TEXELS = 512


def corner_poses(count):
    """Return camera-to-world poses (count, 3, 4) on an arc, looking into the corner at the origin."""
    angle = torch.linspace(0.35, 1.2, count, dtype=torch.float64)
    eyes = torch.stack([3.4 * angle.cos(), 3.4 * angle.sin(), 1.5 + 0.5 * (3 * angle).sin()], dim=-1)
    target = torch.tensor([0.5, 0.5, 0.6], dtype=torch.float64).expand_as(eyes)
    return look_at(eyes, target, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)).numpy()


@cache
def noise(side, seed):
    """Return a gray picture (side, side) with blobs of several sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((side, side))
    for blob in (4, 8, 16, 32):
        cells = Image.fromarray(rng.random((side // blob, side // blob)).astype(np.float32))
        total += np.asarray(cells.resize((side, side), Image.Resampling.BICUBIC))
    return (255 * (total - total.min()) / np.ptp(total)).astype(np.uint8)


def photograph(c2w, first_wall=0):
    """Return what a camera sees of the corner as (HEIGHT, WIDTH) gray levels; other walls make another place."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    across, up = (columns - WIDTH / 2) / FOCAL, (HEIGHT / 2 - rows) / FOCAL
    directions = np.stack([across, up, -np.ones_like(up)], axis=-1) @ c2w[:, :3].T
    picture, nearest = np.zeros((HEIGHT, WIDTH), np.uint8), np.full((HEIGHT, WIDTH), np.inf)
    for axis, others in enumerate([(1, 2), (0, 2), (0, 1)]):
        distance = -c2w[axis, 3] / directions[..., axis]
        hit = c2w[:, 3] + distance[..., None] * directions
        row, column = np.moveaxis((hit[..., others] / WALL * TEXELS).clip(0, TEXELS - 1).astype(int), -1, 0)
        seen = (distance > 0) & (distance < nearest)
        picture[seen] = noise(TEXELS, first_wall + axis)[row, column][seen]
        nearest[seen] = distance[seen]
    return picture


def write_corner(folder, count=8):
    """Write the photographs as `view 0.png`, ...; return their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = corner_poses(count)
    for number, c2w in enumerate(poses):
        Image.fromarray(photograph(c2w)).save(folder / f"view {number}.png")
    return poses
