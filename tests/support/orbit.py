"""Cameras on a circle with a lens that bends, random images and masks: data for what trains a few steps."""

import math

import numpy as np
import torch

import nerf_lightning as nl
from nerf_lightning.nerf.geometry.poses import flip_yz, look_at

LENS = (0.1, -0.02, 0.001, -0.002)
"""k1, k2, p1, p2."""
SIZE = (12, 10)
MATRIX = torch.tensor([[14.0, 0.0, 6.0], [0.0, 14.0, 5.0], [0.0, 0.0, 1.0]])


def orbit_poses(count):
    """Poses with OpenCV's axes (float32) around the origin."""
    angle = torch.arange(count) * (2 * math.pi / count)
    eyes = torch.stack([4 * angle.cos(), 4 * angle.sin(), torch.full_like(angle, 2.0)], dim=-1)
    return flip_yz(look_at(eyes, torch.zeros(count, 3), up=torch.tensor([0.0, 0.0, 1.0])))


def orbit_images(count, size):
    return np.random.default_rng(0).integers(0, 256, (count, size[1], size[0], 3), dtype=np.uint8)


def orbit_masks(count, size):
    """Masks that leave out a fifth of the pixels."""
    return np.random.default_rng(1).random((count, size[1], size[0])) > 0.2


def orbit_cameras(count=6, **changed):
    return nl.Cameras.from_opencv(orbit_poses(count), MATRIX, SIZE, **changed)


def orbit_scene(cameras=None, space="bounded", **changed):
    """Return six views; without a lens, if no cameras are given."""
    given = orbit_cameras() if cameras is None else cameras
    return nl.scene_from_cameras(orbit_images(6, SIZE), given, name="orbit", space=space, **changed)
