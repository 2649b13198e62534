"""Tiny captures on disk, made by the tests that read them."""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

FOV = 0.8
REAL = Path(os.environ.get("NERF_LIGHTNING_DATA", Path(__file__).parents[3] / "shared" / "data"))


def real_capture(name: str) -> Path:
    """Return a folder of the real captures, or skip the test."""
    if not (REAL / name).is_dir():
        pytest.skip(f"{REAL / name} does not exist; NERF_LIGHTNING_DATA names the folder of the real captures")
    return REAL / name


def pose(view: int) -> list[list[float]]:
    """Return a camera four units away that is turned around the vertical axis by `view` steps."""
    c, s = math.cos(0.3 * view), math.sin(0.3 * view)
    return [[c, 0.0, s, 4 * s], [0.0, 1.0, 0.0, 0.0], [-s, 0.0, c, 4 * c], [0.0, 0.0, 0.0, 1.0]]


def picture(view: int, width: int = 8, height: int = 8) -> np.ndarray:
    """Return random RGBA; a quarter of the pixels are transparent, and keep their color."""
    rng = np.random.default_rng(view)
    rgba = rng.integers(0, 256, (height, width, 4), dtype=np.uint8)
    rgba[..., 3][rng.random((height, width)) < 0.25] = 0
    return rgba


def write_transforms(root: Path, split: str, frames: list[dict[str, object]], **changed: object) -> Path:
    path = root / f"transforms_{split}.json"
    path.write_text(json.dumps({"camera_angle_x": FOV, "frames": frames} | changed))
    return path


def write_blender(root: Path, counts: Mapping[str, int], width: int = 8, height: int = 8) -> Path:
    """Write a Blender capture; view i of a split is `picture(i)` seen from `pose(i)`."""
    for split, count in counts.items():
        (root / split).mkdir(parents=True, exist_ok=True)
        frames = []
        for view in range(count):
            Image.fromarray(picture(view, width, height)).save(root / split / f"r_{view}.png")
            frames.append({"file_path": f"./{split}/r_{view}", "transform_matrix": pose(view)})
        write_transforms(root, split, frames)
    return root


def npz_content(count: int = 10, width: int = 6, height: int = 4) -> dict[str, np.ndarray]:
    images = np.stack([picture(view, width, height)[..., :3] for view in range(count)])
    return {
        "images": images.astype(np.float32) / 255,
        "poses": np.array([pose(view) for view in range(count)], dtype=np.float32),
        "focal": np.array(7.5),
    }


def write_npz(path: Path, **changed: np.ndarray) -> Path:
    """Write the npz layout; an array given as None is left out."""
    content = npz_content() | changed
    np.savez(path, **{key: value for key, value in content.items() if value is not None})
    return path
