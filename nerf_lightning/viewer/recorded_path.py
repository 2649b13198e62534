"""A camera path that somebody records by keyframes, and saves under a name that is free."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.nerf.types.scene import SceneRecord
from nerf_lightning.video.paths.keyframes import Keyframe, Point, write_keyframes
from nerf_lightning.viewer import limits
from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.plain_text import as_plain_markdown

LEAST_SECONDS = 0.1
# Letters of a message: it names a file, and shall be whole.
MOST_SAID = 5000


class RecordedPath:
    """Collect keyframes and write them.

    Args:
        session: whose camera it is.
        folder: where the yaml goes.
        draw: shows a keyframe (number, pose, field of view in radians, width over height); returns a handle.
    """

    def __init__(self, session: ViewerClient, folder: Path, draw: Callable[[int, Tensor, float, float], Any]):
        self.session, self.folder, self.draw = session, folder, draw
        self.keyframes: list[Keyframe] = []
        self.times: list[float] = []
        """Seconds from the first keyframe."""
        self.handles: list[Any] = []

    def add(self, seconds: float) -> str:
        """Add the camera as it is now, so many seconds after the one before; return what to say (markdown)."""
        if len(self.keyframes) >= limits.MOST_KEYFRAMES:
            return f"A path has {limits.MOST_KEYFRAMES} keyframes at most. Save it, then remove some."
        seconds = min(max(seconds, LEAST_SECONDS), limits.MOST_SECONDS_BETWEEN)
        camera = self.session.client.camera
        self.times.append(self.times[-1] + seconds if self.times else 0.0)
        record = self.session.photographs.record
        position, look_at, up = map(torch.tensor, (camera.position, camera.look_at, camera.up_direction))
        self.keyframes.append(keyframe_in_user_frame(position, look_at, up, float(camera.fov), self.times[-1], record))
        self.handles.append(self.draw(len(self.keyframes), self.session.pose(), camera.fov, camera.aspect))
        return self._count()

    def remove_last(self) -> str:
        """Take the last keyframe away; return what to say."""
        if self.keyframes:
            self.keyframes.pop()
            self.times.pop()
            self.handles.pop().remove()
        return self._count()

    def save(self) -> str:
        """Write the yaml; return what to say (markdown)."""
        if len(self.keyframes) < 2:
            return "A path needs two keyframes or more."
        try:
            with free_name(self.folder, "camera_path", ".yaml", limits.MOST_PATHS) as path:
                write_keyframes(path, self.keyframes)
        except OSError as error:
            return as_plain_markdown(not_saved(error), MOST_SAID)
        return (
            f"Saved. To film it, add to nerf render: {as_plain_markdown(f'path=keyframes path.file={path}', MOST_SAID)}"
        )

    def _count(self) -> str:
        if not self.keyframes:
            return "No keyframes yet."
        return f"{len(self.keyframes)} keyframes, {self.times[-1]:.1f} s"


def keyframe_in_user_frame(
    position: Float[Tensor, "3"],
    look_at: Float[Tensor, "3"],
    up: Float[Tensor, "3"],
    fov: float,
    time: float,
    record: SceneRecord,
) -> Keyframe:
    """Return a keyframe of a camera in the model's frame.

    `fov` is vertical, in radians. A film has the photographs' shape, not the window's, and keeps this field.
    """
    linear, offset = record.to_user[:3, :3].double(), record.to_user[:3, 3].double()
    shape = float(record.cameras.width[0]) / float(record.cameras.height[0])
    return Keyframe(
        position=_rounded(linear @ position.double() + offset),
        look_at=_rounded(linear @ look_at.double() + offset),
        up=_rounded(normalize(linear @ up.double(), dim=0)),
        fov=round(math.degrees(2 * math.atan(shape * math.tan(fov / 2))), 3),
        time=round(time, 3),
    )


def _rounded(values: Tensor) -> Point:
    x, y, z = (round(value, 6) for value in values.tolist())
    return x, y, z


@contextmanager
def free_name(folder: Path, stem: str, ending: str, most: int) -> Iterator[Path]:
    """Lend a path with the first number that no file has; names never come from the page.

    An empty file keeps the name, so that of several browsers that save at once each has its own; it goes where the
    block fails.

    Raises:
        OSError: there are `most` such files already (more clicks would fill the disk), or it cannot be made.
    """
    path = _made(folder, stem, ending, most)
    try:
        yield path
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _made(folder: Path, stem: str, ending: str, most: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(1, most + 1):
        path = folder / f"{stem}_{number:03d}{ending}"
        with suppress(FileExistsError):
            path.touch(exist_ok=False)
            return path
    raise OSError(f"{folder} holds {most} of them, the most that the page writes")


def not_saved(error: OSError) -> str:
    """Return what to tell a person whose file could not be written."""
    return f"It could not be saved: {error}. Make room, or start again with another paths.output_dir=DIR."
