"""A camera path over the picture: its keyframes as cameras, and the line that the camera goes along."""

from itertools import pairwise
from typing import Any

import numpy as np
import torch

from nerf_lightning.viewer.client import ViewerClient
from nerf_lightning.viewer.frusta import ROOT, SCALE, draw_camera
from nerf_lightning.viewer.recorded_path import RecordedPath

PATH = f"{ROOT}/path"
ORANGE = (240, 120, 20)
# Pieces of the line for each leg of the path, and in all.
PIECES, MOST_PIECES = 24, 2000
THICKNESS = 3.0
# Who stands within this many sizes of a keyframe's camera has its lines all around: they are not drawn.
INSIDE = 3.0


class PathDrawing:
    """Draw a path into what one person sees.

    Args:
        session: of that person.
    """

    def __init__(self, session: ViewerClient):
        self.session, self.scene = session, session.client.scene
        self.size = SCALE * session.around.radius
        self._cameras: list[Any] = []
        self._line: Any = None
        self._places = torch.zeros(0, 3)
        self._shown: list[bool] = []
        session.on_move = self.notice

    def draw(self, path: RecordedPath) -> None:
        """Draw a path in place of the one before."""
        for handle in (*self._cameras, self._line):
            if handle is not None:
                handle.remove()
        poses = path.poses()
        self._cameras = [
            draw_camera(self.scene, f"{PATH}/{number}", c2w, fov, path.shape, self.size, ORANGE)
            for number, (c2w, fov) in enumerate(zip(poses, path.fovs(), strict=True))
        ]
        self._shown, self._places = [True] * len(poses), poses[:, :, 3]
        self._line = self._draw_line(path)
        self.notice()
        self.session.draw_over("path", bool(self._cameras))

    def notice(self) -> None:
        """Hide the keyframes that the person stands in: whoever has just added one would look out of it."""
        places, cameras = self._places, self._cameras
        away = (places - self.session.pose()[:, 3]).norm(dim=-1) > INSIDE * self.size
        for number, shown in enumerate(away.tolist()):
            if shown != self._shown[number]:
                self._shown[number] = cameras[number].visible = shown

    def _draw_line(self, path: RecordedPath) -> Any:
        curve = path.curve()
        if curve is None:
            return None
        pieces = min(PIECES * (len(path.keyframes) - 1), MOST_PIECES)
        at = torch.linspace(0.0, path.seconds, pieces + 1, dtype=curve.knots.dtype)
        places = curve.poses(at)[:, :, 3].numpy()
        ends = np.array(list(pairwise(places)))
        return self.scene.add_line_segments(f"{PATH}/line", ends, ORANGE, thickness=THICKNESS, thickness_units="screen")
