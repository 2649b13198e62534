"""The exact surface of the bricks, and how far a mesh is from it."""

import numpy as np
from scipy.spatial import cKDTree

from nerf_lightning.data.bricks.parts import fire_engine
from nerf_lightning.data.bricks.solids import NOTHING, Solids

# Minimum elevation of the lines above the horizon, like that of the photographs (sine).
LOWEST = 0.05
REACH = 2.1
AT_ONCE = 4_000


def exact_surface(count: int, seed: int = 0) -> np.ndarray:
    """Return points of the surface that can be seen from above: the first hits of lines in all directions."""
    rng, solids, found, total = np.random.default_rng(seed), Solids.of(fire_engine()), [], 0
    while total < count:
        height, turn = rng.uniform(LOWEST, 1.0, AT_ONCE), rng.uniform(0, 2 * np.pi, AT_ONCE)
        wide = np.sqrt(1 - height**2)
        back = np.stack([wide * np.cos(turn), wide * np.sin(turn), height])
        aside = np.stack([-np.sin(turn), np.cos(turn), np.zeros(AT_ONCE)])
        radius, angle = REACH * np.sqrt(rng.uniform(size=AT_ONCE)), rng.uniform(0, 2 * np.pi, AT_ONCE)
        across = radius * (np.cos(angle) * aside + np.sin(angle) * np.cross(back, aside, axis=0))
        origins = 4.0 * back + across
        depth, part = solids.first_hit(origins, -back)
        hit = part != NOTHING
        found.append((origins - depth * back)[:, hit].T)
        total += int(hit.sum())
    return np.concatenate(found)[:count]


def on_mesh(vertices: np.ndarray, faces: np.ndarray, count: int, seed: int = 1) -> np.ndarray:
    """Return points spread evenly over a mesh."""
    rng, (a, b, c) = np.random.default_rng(seed), vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(faces), count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


def distances(points: np.ndarray, to: np.ndarray) -> np.ndarray:
    """Return each point's distance to the nearest of others."""
    return cKDTree(to).query(points)[0]
