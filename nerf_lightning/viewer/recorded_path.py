"""A camera path that somebody records by keyframes."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.viewer.free_name import free_name
from nerf_lightning.viewer.keyframes import Keyframe, keyframe_in_user_frame, write_keyframes
from nerf_lightning.viewer.session import Session


class RecordedPath:
    """Collect keyframes and write them.

    Args:
        session: whose camera it is.
        folder: where the yaml goes.
        draw: shows a keyframe (number, pose, field of view in radians, width over height); returns a handle.
    """

    def __init__(self, session: Session, folder: Path, draw: Callable[[int, Tensor, float, float], Any]):
        self.session, self.folder, self.draw = session, folder, draw
        self.keyframes: list[Keyframe] = []
        self.handles: list[Any] = []

    def add(self, seconds: float) -> str:
        """Add the camera as it is now, so many seconds after the one before; return what to say."""
        camera = self.session.client.camera
        time = self.keyframes[-1].time + seconds if self.keyframes else 0.0
        position, look_at, up = (
            torch.tensor(value).float() for value in (camera.position, camera.look_at, camera.up_direction)
        )
        record = self.session.photographs.record
        frame = keyframe_in_user_frame(position, look_at, up, math.degrees(camera.fov), time, record.to_user)
        self.keyframes.append(frame)
        self.handles.append(self.draw(len(self.keyframes), self.session.pose(), camera.fov, camera.aspect))
        return self._count()

    def remove_last(self) -> str:
        """Take the last keyframe away; return what to say."""
        if self.keyframes:
            self.keyframes.pop()
            self.handles.pop().remove()
        return self._count()

    def save(self) -> str:
        """Write the yaml; return what to say."""
        if len(self.keyframes) < 2:
            return "A path needs two keyframes or more."
        path = free_name(self.folder, "camera_path", ".yaml")
        write_keyframes(path, self.keyframes)
        return f"Saved as {path}"

    def _count(self) -> str:
        if not self.keyframes:
            return "No keyframes yet."
        return f"{len(self.keyframes)} keyframes, {self.keyframes[-1].time:.1f} s"
