"""Draw over the picture: the cameras of the photographs, the crop box, and the camera path.

Which photographs have a frustum: `frustum_views` in `shown_photographs.py`.
"""

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.extensions.viewer.camera_state import quaternion_of
from nerf_lightning.extensions.viewer.client import ViewerClient
from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.video.paths.recorded_path import RecordedPath

ROOT, CAMERAS, BOX, PATH = "/overlay", "/overlay/cameras", "/overlay/crop", "/overlay/path"
GREY, BLUE, ORANGE = (90, 90, 90), (40, 110, 220), (240, 120, 20)
# Size of a frustum as a share of the photographs' distance, and its maximum as a share of that between neighbors.
SCALE, OF_GAP = 0.02, 0.3
LEAST_SCALE = 0.004  # Frames of a film are closer than frusta may be small.
PIECES, MOST_PIECES = 24, 2000  # Segments of the path's line per leg, and maximum in total.
INSIDE = 8.0  # A camera within this many of its sizes would hide the scene from the viewer: it is not drawn.
THICKNESS = 1.5  # Of a frustum's lines (pixels).


class Frusta:
    """Draw cameras, the crop box and the path for one user; `on_click` takes a clicked camera's view."""

    def __init__(self, session: ViewerClient, on_click: Callable[[int], None]):
        self.session, self.scene = session, session.client.scene
        self.size = frustum_size(session.photographs.record.cameras.c2w[:, :, 3], session.around.radius)
        self.root = self.scene.add_frame(ROOT, show_axes=False)
        self.cameras = self.scene.add_frame(CAMERAS, show_axes=False, visible=False)
        self.on_click, self.has_cameras = on_click, False
        self.box: Any = None
        self._path: list[Any] = []
        self._keyframes: list[tuple[Any, Tensor]] = []
        self._photographed: list[tuple[Any, Tensor]] = []
        session.on_move = self._hide_around

    def show(self, visible: bool) -> None:
        """Show or hide the cameras of the photographs."""
        if visible and not self.has_cameras:
            self.has_cameras = True
            self._photographed = [self._add_camera(view) for view in self.session.photographs.frustum_views]
            self._hide_around()
        self.cameras.visible = visible
        self.session.draw_over("cameras", visible)

    def hide(self, hidden: bool) -> None:
        """Hide everything while a photograph is compared with its render, or a path is played."""
        self.root.visible = not hidden

    def draw_box(self, box: CropBox | None) -> None:
        """Draw the crop box, or remove it."""
        if self.box is not None:
            self.box.remove()
            self.box = None
        if box is not None:
            ends = box_edges(box).double().numpy()
            self.box = self.scene.add_line_segments(BOX, ends, BLUE, thickness=2.0, thickness_units="screen")
        self.session.draw_over("crop box", box is not None)

    def draw_path(self, path: RecordedPath) -> None:
        """Replace the drawn path: its keyframes as cameras, and the line that the camera follows."""
        for handle in self._path:
            handle.remove()
        self._path, self._keyframes = [], []
        for number, (c2w, fov) in enumerate(path.views()):
            camera = self._frustum(f"{PATH}/{number}", c2w, fov, path.shape, ORANGE)
            self._path.append(camera)
            self._keyframes.append((camera, c2w[:, 3]))
        if (curve := path.curve()) is not None:
            pieces = min(PIECES * (len(path.keyframes) - 1), MOST_PIECES)
            at = torch.linspace(0.0, path.times[-1], pieces + 1, dtype=curve.knots.dtype)
            ends = np.array(list(pairwise(curve.poses(at)[:, :, 3].numpy())))
            line = self.scene.add_line_segments(f"{PATH}/line", ends, ORANGE, thickness=3.0, thickness_units="screen")
            self._path.append(line)
        self._hide_around()
        self.session.draw_over("path", bool(self._path))

    def _hide_around(self) -> None:
        """Hide the cameras around the user's viewpoint, who would look out of them: after adding a keyframe, too."""
        here = self.session.pose()[:, 3]
        for camera, place in (*self._photographed, *self._keyframes):
            shown = float((place - here).norm()) > INSIDE * self.size
            if camera.visible is not shown:
                camera.visible = shown

    def _add_camera(self, view: int) -> tuple[Any, Tensor]:
        photographs = self.session.photographs
        cameras = photographs.record.cameras
        shape = int(cameras.width[view]) / int(cameras.height[view])
        fov, thumbnail = vertical_field_of_view(cameras, view), photographs.thumbnail(view)
        image = None if thumbnail is None else thumbnail.numpy()
        handle = self._frustum(f"{CAMERAS}/{view}", cameras.c2w[view], fov, shape, GREY, image)
        handle.on_click(self.session.queue.errors.harmless(lambda _: self.on_click(view)))
        return handle, cameras.c2w[view][:, 3]

    def _frustum(
        self,
        name: str,
        c2w: Float[Tensor, "3 4"],
        fov: float,
        aspect: float,
        color: tuple[int, int, int],
        image: UInt8[np.ndarray, "height width 3"] | None = None,
    ) -> Any:
        """Draw a camera as its viewing pyramid; `fov` is vertical, `aspect` is width over height."""
        look = {"scale": self.size, "thickness": THICKNESS, "thickness_units": "screen", "color": color, "image": image}
        shadows = {"cast_shadow": False, "receive_shadow": False}
        place = {"wxyz": quaternion_of(c2w), "position": c2w[:, 3].double().numpy()}
        return self.scene.add_camera_frustum(name, fov, aspect, **look, **shadows, **place)


def box_edges(box: CropBox) -> Float[Tensor, "12 2 3"]:
    """Return the ends of a box's edges (scene units)."""
    corners = torch.cartesian_prod(*torch.tensor([[0.0, 1.0]] * 3))
    edges = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b - a).min() == 0]
    return box.corner + torch.stack([torch.stack(edge) for edge in edges]) * box.size @ box.axes


def frustum_size(places: Float[Tensor, "cameras 3"], radius: float) -> float:
    """Return the size of frusta for cameras at these places, so that neighbors do not hide each other.

    >>> row = torch.tensor([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.1, 0.0, 0.0]])
    >>> [round(frustum_size(places, 1.0), 4) for places in (row, 20 * row, 0.01 * row)]
    [0.015, 0.02, 0.004]
    """
    gaps = torch.cdist(places, places).fill_diagonal_(math.inf).amin(dim=1)
    return radius * max(LEAST_SCALE, min(SCALE, OF_GAP * float(gaps.median()) / radius))
