"""Fusion of depth maps: as a loop in numpy has it; planes, balls and boxes of exact depth come back."""

from itertools import product

import numpy as np
import pytest
import torch

from nerf_lightning.extensions.geometry_exports.density_grid import Lattice
from nerf_lightning.extensions.geometry_exports.density_mesh import marching_cubes
from nerf_lightning.extensions.geometry_exports.tsdf_fusion import add_view
from nerf_lightning.nerf.geometry.cameras import all_pixels, pinhole_cameras, rays_through_pixels
from nerf_lightning.nerf.geometry.poses import look_at


def numbers_of(cameras, view):
    return torch.cat([cameras.c2w[view].reshape(-1), cameras.focal[view], cameras.center[view]]).numpy()


def cameras_around(count, size):
    """Evenly spread over the sphere."""
    number = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * number / count, torch.pi * (1 + 5**0.5) * number
    level = (1 - height**2).sqrt()
    eyes = 4.0 * torch.stack([level * turn.cos(), level * turn.sin(), height], dim=-1)
    up = torch.tensor([0.1, 0.2, 1.0], dtype=torch.float64)
    return pinhole_cameras(look_at(eyes, torch.zeros_like(eyes), up).float(), 1.6 * size, size, size)


def reference(lattice, views, truncation):
    """The same mean, point by point: nearest pixels only."""
    mean, total = np.zeros(lattice.shape), np.zeros(lattice.shape)
    for index in product(*map(range, lattice.shape)):
        point = lattice.lower.numpy() + lattice.spacing * np.array(index)
        for camera, depth, trust in views:
            c2w, (fx, fy, cx, cy) = camera[:12].reshape(3, 4).astype(float), camera[12:].astype(float)
            right, up, back = (point - c2w[:, 3]) @ c2w[:, :3]
            if -back <= lattice.spacing:
                continue
            x, y = int(np.floor(-fx * right / back + cx)), int(np.floor(fy * up / back + cy))
            if not (0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]) or trust[y, x] <= 0:
                continue
            before = (depth[y, x] - np.linalg.norm(point - c2w[:, 3])) / truncation
            if before > -1:
                mean[index] += trust[y, x] * min(before, 1.0)
                total[index] += trust[y, x]
    return mean / np.maximum(total, 1e-9), total


def fused(lattice, views, truncation):
    distance, weight = np.zeros(lattice.shape, np.float32), np.zeros(lattice.shape, np.float32)
    for camera, depth, trust in views:
        add_view(distance, weight, lattice.lower.numpy(), lattice.spacing, camera, depth, trust, truncation)
    return distance, weight


def test_it_is_the_mean_that_a_loop_finds():
    cameras, rng = cameras_around(3, 12), np.random.default_rng(0)
    lattice = Lattice.over(torch.tensor([[-1.0, -0.9, -0.8], [1.0, 0.9, 0.8]]), 10)
    # Depths that jump from pixel to pixel, so that nothing is interpolated; some rays meet nothing, some are unknown.
    checker = 1.2 * (np.indices((12, 12)).sum(axis=0) % 2)
    views = []
    for view in range(3):
        depth = (3.4 + checker + 0.1 * rng.uniform(size=(12, 12))).astype(np.float32)
        depth[2:4] = np.inf
        trust = rng.uniform(0.1, 1.0, (12, 12)).astype(np.float32)
        trust[:, 5] = 0.0
        views.append((numbers_of(cameras, view), depth, trust))
    distance, weight = fused(lattice, views, 0.5)
    expected, total = reference(lattice, views, 0.5)
    assert (total == 0).any()
    assert (total > 0).mean() > 0.5
    np.testing.assert_allclose(weight, total, atol=1e-5)
    np.testing.assert_allclose(distance, expected, atol=1e-4)


def ball(rays):
    """The distance to a ball of radius 0.8 around the origin."""
    along = -(rays.origins * rays.directions).sum(-1)
    closest = rays.origins + along[..., None] * rays.directions
    return along - (0.8**2 - closest.square().sum(-1)).sqrt(), lambda points: np.linalg.norm(points, axis=1) - 0.8


HALF = (0.7, 0.5, 0.6)


def box(rays):
    """The distance to a box around the origin."""
    one, other = (sign * torch.tensor(HALF) - rays.origins for sign in (-1, 1))
    slabs = torch.stack([one, other]) / rays.directions
    enter, leave = slabs.amin(dim=0).amax(dim=-1), slabs.amax(dim=0).amin(dim=-1)

    def distance(points):
        beyond = np.abs(points) - HALF
        return np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0)

    return torch.where(enter < leave, enter, torch.nan), distance


@pytest.mark.parametrize(("shape", "typical", "farthest"), [(ball, 0.1, 0.4), (box, 0.06, 0.5)])
def test_exact_depth_comes_back_to_a_fraction_of_a_cell(shape, typical, farthest):
    cameras = cameras_around(24, 96)
    lattice = Lattice.over(torch.tensor([[-1.0] * 3, [1.0] * 3]), 48)
    views = []
    for view in range(24):
        rays = rays_through_pixels(cameras, all_pixels(cameras, view), torch.zeros(24), torch.full((24,), 8.0))
        depth, distance = shape(rays)
        down, along = torch.gradient(rays.origins + depth[..., None] * rays.directions, dim=(0, 1))
        normals = torch.nn.functional.normalize(torch.linalg.cross(down, along), dim=-1)
        cosine = (normals * rays.directions).sum(dim=-1).abs().nan_to_num(0.3).float().numpy()
        depth = torch.where(depth.isnan(), torch.inf, depth).float().numpy()
        views.append((numbers_of(cameras, view), depth, cosine))
    fields, weight = fused(lattice, views, 3 * lattice.spacing)
    vertices, faces = marching_cubes(-fields, 0.0, lambda stage, done: None)
    cell = np.floor(vertices).astype(int)
    error = np.abs(distance(lattice.to_scene(vertices))) / lattice.spacing
    seen = weight[tuple(cell.T)] > 0
    print(f"{shape.__name__}: {np.median(error[seen]):.3f} and at most {error[seen].max():.3f} cells")
    assert len(faces) > 4000
    assert np.median(error[seen]) < typical
    assert error[seen].max() < farthest
