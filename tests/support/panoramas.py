"""Panoramas of the bricks, by formulas of their own."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from nerf_lightning.data.bricks.parts import fire_engine
from nerf_lightning.data.bricks.tracer import Pinhole, Tracer
from nerf_lightning.nerf.geometry.poses import look_at


@dataclass(frozen=True)
class Panorama(Pinhole):
    """All directions around a place; stretched to a square, as the tracer wants it."""

    def directions(self, x, y):
        """Longitude to the right from the camera's -z axis, latitude upwards."""
        longitude, latitude = 2 * np.pi * (x / self.resolution - 0.5), np.pi * (0.5 - y / self.resolution)
        level = np.cos(latitude)
        return self.c2w[:, :3] @ np.stack([level * np.sin(longitude), np.sin(latitude), -level * np.cos(longitude)])

    def rectangles(self, corners):
        """Every part may appear anywhere."""
        whole = np.full((corners.shape[0], 2), float(self.resolution))
        return np.stack([0 * whole, whole])


def near_the_bricks(count: int, distance: float = 2.2) -> torch.Tensor:
    """Poses around the model, close to it, each turned to another side."""
    angle = torch.arange(count, dtype=torch.float64) * 2.4
    eyes = distance * torch.stack([angle.cos(), angle.sin(), 0.25 + 0.15 * (3 * angle).sin()], dim=-1)
    target = torch.stack([(2 * angle).cos(), (3 * angle).sin(), 0 * angle], dim=-1)
    return look_at(eyes, target, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def write_panoramas(root: Path, count: int = 8, size: int = 32, **changed: object) -> Path:
    """Write bricks as nerfstudio writes panoramas, twice as wide as high."""
    (root / "images").mkdir(parents=True)
    c2w = near_the_bricks(count).numpy()
    rgba = Tracer(fire_engine()).pictures([Panorama(pose, 1.0, 2 * size) for pose in c2w]) / 255.0
    pictures = rgba[..., :3] * rgba[..., 3:] + 0.5 * (1.0 - rgba[..., 3:])
    frames = []
    for number, (pose, picture) in enumerate(zip(c2w, pictures, strict=True)):
        flat = picture.reshape(size, 2, 2 * size, 3).mean(axis=1)
        Image.fromarray(np.rint(255 * flat).astype(np.uint8)).save(root / "images" / f"{number:02d}.png")
        matrix = [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": f"images/{number:02d}.png", "transform_matrix": matrix})
    content = {"camera_model": "EQUIRECTANGULAR", "w": 2 * size, "h": size, "fl_x": size, "fl_y": size}
    (root / "transforms.json").write_text(json.dumps(content | {"frames": frames} | changed))
    return root
