"""Many parts at once: the first hit of a ray, whether light is blocked, the free space around a point.

Parts that share a kind of solid and a frame form a group: rays are transformed into the frame once, then intersect all
its parts in one broadcast of (parts, rays). The caller passes few enough rays that these tables fit into the cache.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from nerf_lightning.data.bricks.parts import Part
from nerf_lightning.data.bricks.shapes import Interval, Solid, Vectors

NOTHING = -1
"""Part number of a ray that hits nothing."""


@dataclass(frozen=True)
class Group:
    """Parts of one kind of solid in one frame: centers in its axes, and each part's number in the model."""

    solid: Solid
    frame: Float[ndarray, "3 3"]
    center: Float[ndarray, "3 parts"]
    size: Float[ndarray, "numbers parts"]
    number: Int[ndarray, "parts"]

    def only(self, keep: Bool[ndarray, "parts"]) -> "Group":
        """Return the parts that are marked."""
        return Group(self.solid, self.frame, self.center[:, keep], self.size[:, keep], self.number[keep])

    def local(self, points: Float[ndarray, "3 rays"]) -> Float[ndarray, "3 parts rays"]:
        """Return points relative to each part."""
        return (self.frame.T @ points)[:, None] - self.center[:, :, None]

    def interval(self, origins: Vectors, directions: Vectors) -> Interval:
        """Return where rays enter and leave each part."""
        along = (self.frame.T @ directions)[:, None]
        return self.solid.interval(self.local(origins), along, self.size[:, :, None])


@dataclass(frozen=True)
class Solids:
    """A model, or the candidates among its parts, of which there are `total` in the whole model."""

    groups: tuple[Group, ...]
    total: int

    @classmethod
    def of(cls, parts: Sequence[Part], dtype: type[np.floating] = np.float64) -> "Solids":
        """Group parts; `dtype` is the precision in which they are traced."""
        kinds: dict[tuple[int, bytes], list[int]] = {}
        for number, part in enumerate(parts):
            kinds.setdefault((id(part.solid), part.frame.tobytes()), []).append(number)
        groups = []
        for numbers in kinds.values():
            chosen = [parts[number] for number in numbers]
            frame = chosen[0].frame
            center = frame.T @ np.array([part.center for part in chosen]).T
            size = np.array([part.size for part in chosen]).T
            frame, center, size = frame.astype(dtype), center.astype(dtype), size.astype(dtype)
            groups.append(Group(chosen[0].solid, frame, center, size, np.array(numbers)))
        return cls(tuple(groups), len(parts))

    def only(self, keep: Bool[ndarray, "total"]) -> "Solids":
        """Return the parts that are marked."""
        groups = ((group, keep[group.number]) for group in self.groups)
        return Solids(tuple(group.only(mask) for group, mask in groups if mask.any()), self.total)

    def corners(self) -> Float[ndarray, "total 8 3"]:
        """Return the corners of each part's own bounding box, in the world."""
        signs = np.array(list(product((-1.0, 1.0), repeat=3)))
        found = np.zeros((self.total, 8, 3))
        for group in self.groups:
            half = group.solid.extent(group.size).T
            local = group.center.T[:, None] + signs * half[:, None]
            found[group.number] = local @ group.frame.T
        return found

    def first_hit(
        self, origins: Float[ndarray, "3 #rays"], directions: Float[ndarray, "3 rays"]
    ) -> tuple[Float[ndarray, "rays"], Int[ndarray, "rays"]]:
        """Return the distance and the part's number of the first surface; (inf, `NOTHING`) where there is none.

        Rays start outside every part.
        """
        depth = np.full(directions.shape[1], np.inf, directions.dtype)
        number = np.full(directions.shape[1], NOTHING)
        for group in self.groups:
            entry, exit = group.interval(origins, directions)
            entry[(entry > exit) | (entry <= 0)] = np.inf
            nearest = entry.argmin(axis=0)
            distance = np.take_along_axis(entry, nearest[None], axis=0)[0]
            closer = distance < depth
            depth[closer] = distance[closer]
            number[closer] = group.number[nearest[closer]]
        return depth, number

    def blocked(
        self, origins: Float[ndarray, "3 rays"], directions: Float[ndarray, "3 #rays"]
    ) -> Bool[ndarray, "rays"]:
        """Return which rays hit a part anywhere."""
        found = np.zeros(origins.shape[1], bool)
        for group in self.groups:
            entry, exit = group.interval(origins, directions)
            found |= ((entry < exit) & (exit > 0)).any(axis=0)
        return found

    def room(self, points: Float[ndarray, "3 points"], reach: float) -> Float[ndarray, "points"]:
        """Return the distance to the nearest part, at most `reach`; negative inside."""
        nearest = np.full(points.shape[1], reach, points.dtype)
        for group in self.groups:
            distance = group.solid.distance(group.local(points), group.size[:, :, None])
            np.minimum(nearest, distance.min(axis=0), out=nearest)
        return nearest

    def normals(self, points: Float[ndarray, "3 points"], number: Int[ndarray, "points"]) -> Float[ndarray, "3 points"]:
        """Return the outward unit normal of the part `number` at points of its surface."""
        normals = np.zeros_like(points)
        for group in self.groups:
            mine = np.flatnonzero(np.isin(number, group.number))
            which = np.searchsorted(group.number, number[mine])
            local = group.frame.T @ points[:, mine] - group.center[:, which]
            normals[:, mine] = group.frame @ group.solid.normal(local, group.size[:, which])
        return normals
