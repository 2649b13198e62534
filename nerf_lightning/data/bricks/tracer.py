"""Trace tiles of a picture against the parts that can appear in them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from nerf_lightning.data.bricks.light import DAY, SIDES, Light, key_visible, openness, palette, shade
from nerf_lightning.data.bricks.parts import Part
from nerf_lightning.data.bricks.solids import NOTHING, Solids

TILE = 16
"""Side of a tile in pixels, doubled with one ray per pixel: few candidates per ray, yet enough rays per call."""


@dataclass(frozen=True)
class Pinhole:
    """One square view, in float64; the focal length in pixels."""

    c2w: Float[ndarray, "3 4"]
    focal: float
    resolution: int

    def directions(self, x: Float[ndarray, "rays"], y: Float[ndarray, "rays"]) -> Float[ndarray, "3 rays"]:
        """Return unit rays through points of the picture, in pixels from the upper left corner."""
        middle = self.resolution / 2
        local = np.stack([(x - middle) / self.focal, (middle - y) / self.focal, -np.ones_like(x)])
        world = self.c2w[:, :3] @ local
        return world / np.sqrt(np.sum(world**2, axis=0))

    def rectangles(self, corners: Float[ndarray, "parts 8 3"]) -> Float[ndarray, "2 parts 2"]:
        """Return the upper left and lower right of the parts' boxes in the picture, in pixels (x, y)."""
        local = (corners - self.c2w[:, 3]) @ self.c2w[:, :3]
        plane = local[..., :2] * np.array([1, -1]) / -local[..., 2:] * self.focal + self.resolution / 2
        return np.stack([plane.min(axis=1), plane.max(axis=1)])


@dataclass(frozen=True)
class Hits:
    """The rays that hit something; pixels of the picture and rays of a pixel are numbered row by row."""

    pixel: Int[ndarray, "hits"]
    ray: Int[ndarray, "hits"]
    part: Int[ndarray, "hits"]
    depth: Float[ndarray, "hits"]
    points: Float[ndarray, "3 hits"]
    directions: Float[ndarray, "3 hits"]


class Tracer:
    """Trace one model. Colors take float32, geometry float64."""

    def __init__(self, parts: Sequence[Part], light: Light = DAY) -> None:
        self.light = light
        self.solids, self.fast = Solids.of(parts, np.float64), Solids.of(parts, np.float32)
        self.palette, self.corners = palette(parts, np.float32), self.solids.corners()

    def pictures(self, views: Sequence[Pinhole]) -> UInt8[ndarray, "views pixels 4"]:
        """Return straight RGBA: alpha is the share of a pixel's 4 x 4 rays that hit, color the mean of those hits.

        The mean is taken over sRGB codes, because that is how radiance fields and viewers blend them. Views of one call
        share the search for shadows, which is faster and changes no value; they have the same resolution.
        """
        pixels = views[0].resolution ** 2
        each = [self.find(view, SIDES, self.fast) for view in views]
        pixel = np.concatenate([hits.pixel + i * pixels for i, hits in enumerate(each)])
        hits = _joined(each)
        normals = self.fast.normals(hits.points, hits.part)
        lit = key_visible(self.fast, hits.points, normals, hits.ray, self.light)
        open_ = self._openness(hits, normals, pixel)
        colors = shade(self.palette, self.light, hits.part, normals, hits.directions, lit, open_)
        count = np.bincount(pixel, minlength=len(views) * pixels)
        sums = [np.bincount(pixel, channel, minlength=count.size) for channel in colors]
        rgb = np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None]
        rgba = np.rint(255 * np.column_stack([rgb, count / SIDES**2])).astype(np.uint8)
        return rgba.reshape(len(views), pixels, 4)

    def geometry(self, view: Pinhole) -> tuple[Float[ndarray, "pixels"], Float[ndarray, "pixels 3"]]:
        """Return depth (inf: nothing) and world normals (zero: nothing) through the pixels' centers."""
        hits = self.find(view, 1, self.solids)
        depth = np.full(view.resolution**2, np.inf, np.float32)
        normals = np.zeros((view.resolution**2, 3), np.float32)
        depth[hits.pixel] = hits.depth
        normals[hits.pixel] = self.solids.normals(hits.points, hits.part).T
        return depth, normals

    def find(self, view: Pinhole, sides: int, solids: Solids) -> Hits:
        """Return the first hits of `sides` x `sides` rays through each pixel, centered in equal squares."""
        upper, lower = view.rectangles(self.corners)
        tile = TILE if sides > 1 else 2 * TILE
        found = [_trace_tile(view, 0, 0, 0, sides, solids)]
        for top in range(0, view.resolution, tile):
            row = (lower[:, 1] >= top) & (upper[:, 1] <= top + tile)
            for left in range(0, view.resolution, tile):
                inside = row & (lower[:, 0] >= left) & (upper[:, 0] <= left + tile)
                if inside.any():
                    found.append(_trace_tile(view, left, top, tile, sides, solids.only(inside)))
        return _joined(found)

    def _openness(
        self, hits: Hits, normals: Float[ndarray, "3 hits"], pixel: Int[ndarray, "hits"]
    ) -> Float[ndarray, "hits"]:
        """Return each pixel's mean openness, queried only on the diagonal of the 4 x 4 rays, as it varies slowly.

        If no ray on the diagonal hits, every ray of the pixel is queried.
        """
        asked = hits.ray % (SIDES + 1) == 0
        asked |= np.bincount(pixel, asked)[pixel] == 0
        values = openness(self.fast, hits.points[:, asked], normals[:, asked], hits.ray[asked])
        sums, counts = np.bincount(pixel[asked], values), np.bincount(pixel[asked])
        return (sums / np.maximum(counts, 1)).astype(values.dtype)[pixel]


def _joined(each: Sequence[Hits]) -> Hits:
    return Hits(*(np.concatenate([getattr(f, name) for f in each], axis=-1) for name in vars(each[0])))


def _trace_tile(view: Pinhole, left: int, top: int, tile: int, sides: int, candidates: Solids) -> Hits:
    """Return the hits in a square of `tile` pixels, cut off at the picture's edge."""
    columns = np.arange(left, min(left + tile, view.resolution))
    rows = np.arange(top, min(top + tile, view.resolution))
    steps = (np.arange(sides) + 0.5) / sides
    shape = (rows.size, columns.size, sides, sides)
    x = np.broadcast_to(columns[None, :, None, None] + steps, shape).reshape(-1)
    y = np.broadcast_to(rows[:, None, None, None] + steps[:, None], shape).reshape(-1)
    dtype = candidates.groups[0].center.dtype
    origin, directions = view.c2w[:, 3:].astype(dtype), view.directions(x, y).astype(dtype)
    depth, part = candidates.first_hit(origin, directions)
    hit = np.flatnonzero(part != NOTHING)
    pixel = y[hit].astype(np.int64) * view.resolution + x[hit].astype(np.int64)
    points = origin + depth[hit] * directions[:, hit]
    return Hits(pixel, hit % sides**2, part[hit], depth[hit], points, directions[:, hit])
