"""Panoramas of a room whose walls, floor and ceiling are covered with noise, along a walk whose poses are known."""

from pathlib import Path

import numpy as np
from PIL import Image
from support.corner import noise

SIZE = np.array([6.0, 5.0, 3.0])
"""Of the room along x, y and z (upwards), from the origin."""
CARRIER = 0.8
"""Of a panorama's height: below, it shows who carries the camera, always at the same place."""
TEXELS = 256
SUBPIXELS = 2


def walk(count: int) -> np.ndarray:
    """Return camera-to-world poses (count, 3, 4), axes right, up, back: about upright, each turned to another side."""
    rng = np.random.default_rng(0)
    along = np.linspace(0.0, 1.7 * np.pi, count)
    eyes = np.stack([3.0 + 1.4 * np.cos(along), 2.5 + 1.1 * np.sin(along), 1.5 + 0.3 * np.sin(3 * along)], axis=-1)
    poses = []
    for number, eye in enumerate(eyes):
        yaw, (roll, pitch) = 0.7 * number, rng.normal(0.0, 0.05, 2)
        forward = np.array([np.cos(yaw), np.sin(yaw), pitch])
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [np.sin(roll) * np.sin(yaw), -np.sin(roll) * np.cos(yaw), np.cos(roll)])
        right /= np.linalg.norm(right)
        poses.append(np.column_stack([right, np.cross(right, forward), -forward, eye]))
    return np.array(poses)


def directions(c2w: np.ndarray, x: np.ndarray, y: np.ndarray, height: int) -> np.ndarray:
    """Return the unit directions (*places, 3) of places in a panorama, in pixels from its upper left corner."""
    longitude, latitude = np.pi * (x / height - 1.0), np.pi * (0.5 - y / height)
    level = np.cos(latitude)
    local = np.broadcast_arrays(level * np.sin(longitude), np.sin(latitude), -level * np.cos(longitude))
    return np.stack(local, axis=-1) @ c2w[:, :3].T


def to_walls(eye: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Return how far away the walls across x, y and z are in some directions, the nearest of which is seen."""
    return np.where(toward > 0.0, SIZE - eye, -eye) / toward


def panorama(c2w: np.ndarray, height: int) -> np.ndarray:
    """Return what is seen from a pose in all directions, as (height, 2 height, 3) levels."""
    side = height * SUBPIXELS
    at = (np.arange(2 * side) + 0.5) / SUBPIXELS
    toward = directions(c2w, at, at[:side, None], height)
    distance = to_walls(c2w[:, 3], toward)
    wall = distance.argmin(axis=-1)
    hit = c2w[:, 3] + distance.min(axis=-1)[..., None] * toward
    picture = np.zeros((side, 2 * side, 3), np.float32)
    for axis in range(3):
        for far in (0, 1):
            own = (wall == axis) & ((toward[..., axis] > 0.0) == far)
            texel = (hit[own][:, [other for other in range(3) if other != axis]] / SIZE.max() * TEXELS).astype(int)
            row, column = texel.clip(0, TEXELS - 1).T
            colors = [noise(TEXELS, 10 * (2 * axis + far) + channel)[row, column] for channel in range(3)]
            picture[own] = np.stack(colors, axis=-1)
    picture = picture.reshape(height, SUBPIXELS, 2 * height, SUBPIXELS, 3).mean(axis=(1, 3))
    below = round(CARRIER * height)
    picture[below:] = np.asarray(Image.fromarray(noise(TEXELS, 99)).resize((2 * height, height)))[below:, :, None]
    return np.rint(picture).astype(np.uint8)


def write_room(folder: Path, count: int = 12, height: int = 256) -> np.ndarray:
    """Write panoramas as `around 00.png`, ...; return their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    poses = walk(count)
    for number, c2w in enumerate(poses):
        Image.fromarray(panorama(c2w, height)).save(folder / f"around {number:02d}.png")
    return poses
