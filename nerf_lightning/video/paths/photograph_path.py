"""A smooth path through chosen photographs of the capture."""

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import final

from nerf_lightning.messages.errors import InputError
from nerf_lightning.messages.suggestions import near
from nerf_lightning.nerf.types.scene import Cameras
from nerf_lightning.video.paths.base import CameraPath, PathFrame
from nerf_lightning.video.paths.spline import even_speed, frame_times, poses_along


@final
@dataclass
class PhotographPath(CameraPath):
    """Go from photograph to photograph, with their poses, at about constant speed.

    Args:
        views: photographs in the order of the path: names, patterns ("IMG_01*") or numbers from 0; None: all, in the
            capture's order.
        closed: return to the first one at the end; the last frame then precedes the first.
    """

    views: list[str | int] | None = None
    closed: bool = False

    def cameras(self, around: PathFrame) -> Cameras:
        """Return the cameras between the photographs."""
        count = len(around.poses)
        chosen = list(range(count)) if self.views is None else self.views
        numbers = find_views(chosen, around.view_names, count)
        if len(numbers) < 2:
            named = f"path.views={self.views} names {len(numbers)} photograph(s)"
            raise InputError(f"{named}, and a path needs two. Name more; for a camera that stays, name one twice.")
        keys = around.poses[numbers]
        knots = even_speed(keys, around.radius, self.closed)
        times = frame_times(knots, self.num_frames, self.closed)
        return self.pinholes(poses_along(knots, keys, times), around)


def find_views(chosen: Sequence[str | int], names: Sequence[str], count: int) -> list[int]:
    """Return the numbers of photographs given by name, pattern or number.

    >>> find_views([2, "b", "*"], ["a", "b", "c"], 3)
    [2, 1, 0, 1, 2]
    """
    found: list[int] = []
    for each in [chosen] if isinstance(chosen, str) else chosen:
        if isinstance(each, int) and not isinstance(each, bool):
            numbers = [each] if 0 <= each < count else []
        else:
            exact = [number for number, name in enumerate(names) if name == str(each)]
            numbers = exact or [number for number, name in enumerate(names) if fnmatchcase(name, str(each))]
        if not numbers:
            similar = near(str(each), names) or list(names[:3])
            raise InputError(
                f"path.views: the capture has no photograph {each}. It has {count}, numbered from 0"
                + (f", with names like {', '.join(similar)}." if similar else ".")
            )
        found += numbers
    return found
