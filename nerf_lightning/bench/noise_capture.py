"""A capture of any size to measure with: photographs of nothing, around a point."""

import json
import math
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from nerf_lightning.files.made_folders import make_folder

ANGLE = 0.7
"""Radians that a photograph shows across."""
KINDS = 8
"""Different pictures; the others are their copies, since making noise takes longer than reading it."""


def write_noise_capture(folder: Path, count: int, side: int) -> None:
    """Write so many square photographs (JPEG) of smooth noise, and a transforms.json of cameras on a circle."""
    make_folder(folder)
    random = np.random.default_rng(0)
    frames, pictures = [], []
    for _ in range(min(count, KINDS)):
        coarse = random.integers(0, 256, (side // 8, side // 8, 3), dtype=np.uint8)
        pictures.append(coarse.repeat(8, axis=0).repeat(8, axis=1))
    for number in range(count):
        name, angle = f"{number:05d}.jpg", 2 * math.pi * number / count
        imageio.imwrite(folder / name, pictures[number % KINDS], quality=90)
        frames.append({"file_path": name, "transform_matrix": _camera(angle)})
    about = {"fl_x": side / 2 / math.tan(ANGLE / 2), "w": side, "h": side, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about), encoding="utf-8")


def _camera(angle: float) -> list[list[float]]:
    """Return camera to world, 4 units from the origin and looking at it, 30 degrees above the horizon."""
    up, down = math.sin(math.pi / 6), math.cos(math.pi / 6)
    cos, sin = math.cos(angle), math.sin(angle)
    return [
        [-sin, -up * cos, down * cos, 4 * down * cos],
        [cos, -up * sin, down * sin, 4 * down * sin],
        [0.0, down, up, 4 * up],
        [0.0, 0.0, 0.0, 1.0],
    ]
