"""One user of the page: their viewpoint, what they see, and what is sent to them."""

import threading
from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.extensions.viewer.camera_state import (
    CameraState,
    fov_that_holds,
    point_ahead,
    pose_of,
    quaternion_of,
)
from nerf_lightning.extensions.viewer.channels import COLOR, FARTHEST, in_window, picture_of, planar_depth, wiped
from nerf_lightning.extensions.viewer.progressive import ProgressiveRendering
from nerf_lightning.extensions.viewer.render_queue import RenderQueue
from nerf_lightning.extensions.viewer.renderer import View
from nerf_lightning.extensions.viewer.shown_photographs import Photographs
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.video.paths.base import PathFrame

MOST_SIDE = 4096  # Maximum width and height of a window (pixels); larger ones count as this.
QUALITY = 90  # JPEG quality; a coarse picture is small at any quality.
# Cameras are at most this many times the photographs' distance away: if depths cannot represent that, nothing is
# occluded.
FARTHER = 4
# A viewpoint this near (share of the photographs' distance) to a photograph's, with the same direction, counts as it.
NEAR, SAME_WAY = 2e-3, 1 - 1e-5


class ViewerClient:
    """Convert movements of viser's camera to camera states, and views to what the page shows.

    viser calls this from its own threads; pictures come from the rendering thread, the finest with a height of
    `most_height` pixels.
    """

    def __init__(self, client: Any, queue: RenderQueue, photographs: Photographs, around: PathFrame, most_height: int):
        self.client, self.queue, self.photographs, self.around = client, queue, photographs, around
        self.refinement = ProgressiveRendering(self._show, most_height)
        self.channel, self.split = COLOR, 0.5
        self.crop: CropBox | None = None
        self.photograph: int | None = None
        """The view whose camera is used."""
        self.on_picture: Callable[[View, bool], None] = lambda view, finest: None
        """Called after a picture is sent, with its view, and whether it is the finest."""
        self.on_finest: Callable[[], None] = lambda: None
        self.on_leave: Callable[[], None] = lambda: None
        self.on_move: Callable[[], None] = lambda: None
        """Called when the camera may have moved, before the picture."""
        self._drawn_over: set[str] = set()
        self._arrived = False
        self._last_view: tuple[View, CameraState] | None = None
        self.picture: UInt8[Tensor, "height width 3"] | None = None
        """What was last sent."""
        self._wants_present, self._presenting = False, threading.Lock()
        self._looking = threading.RLock()

    def start(self) -> None:
        """Follow the camera from now on, and show a picture at once."""
        self.client.camera.on_update(self.queue.errors.harmless(lambda _: self.request_view()))
        self.request_view()
        self.queue.add(self.client.client_id, self.refinement)

    def request_view(self) -> None:
        """Request the camera's present view."""
        camera = self.client.camera
        self.on_move()
        with self._looking:  # otherwise a thread that read the camera before it moved could win
            self._notice_leaving()
            width, height = (min(max(1, int(side)), MOST_SIDE) for side in (camera.image_width, camera.image_height))
            self.refinement.ask(CameraState(self.pose(), float(camera.fov), width, height, self.crop, self.photograph))
        self.queue.wake()

    def pose(self) -> Tensor:
        """Return viser's camera as ours."""
        camera = self.client.camera
        return pose_of(torch.tensor(camera.wxyz).float(), torch.tensor(camera.position).float())

    def go(self, c2w: Float[Tensor, "3 4"], fov: float) -> None:
        """Move the user's camera there; the window shows all of a picture with this vertical field (radians)."""
        camera, shape = self.client.camera, self.around.width / self.around.height
        with self.client.atomic():
            camera.position = c2w[:, 3].double().numpy()
            camera.wxyz = quaternion_of(c2w)
            camera.fov = fov_that_holds(fov, shape, camera.aspect)

    def level(self) -> None:
        """Let the user's camera orbit around the capture's up again, after it has been moved."""
        self.client.camera.up_direction = self.around.up.double().numpy()

    def is_here(self) -> bool:
        """Return whether the user is still connected."""
        return self.queue.serves(self.client.client_id)

    def enter(self, view: int) -> None:
        """Look through the camera of a photograph."""
        c2w = self.photographs.record.cameras.c2w[view]
        self.photograph, self._arrived = view, False
        with self.client.atomic():
            self.client.camera.position = c2w[:, 3].double().numpy()
            self.client.camera.look_at = point_ahead(c2w, self.around).double().numpy()
        self.request_view()

    def leave(self) -> None:
        """Look freely again."""
        if self.photograph is not None:
            self.photograph = None
            self.on_leave()
            self.request_view()

    def present(self) -> None:
        """Send the newest view again, as another channel or with another split of the comparison.

        A slider requests this more often than possible: if another thread is already sending, this one leaves it to
        that.
        """
        self._wants_present = True
        while self._wants_present and self._presenting.acquire(blocking=False):
            try:
                self._wants_present = False
                if self._last_view is not None:
                    self._send(*self._last_view)
            finally:
                self._presenting.release()

    def draw_over(self, what: str, drawn: bool) -> None:
        """Register what is drawn over the picture: its depth is then sent too, so that content occludes the drawing."""
        had = bool(self._drawn_over)
        (self._drawn_over.add if drawn else self._drawn_over.discard)(what)
        if bool(self._drawn_over) != had:
            self.present()

    def _show(self, view: View, state: CameraState, finest: bool) -> None:
        self._last_view = view, state
        self._send(view, state)
        self.on_picture(view, finest)
        if finest:
            self.on_finest()

    def _send(self, view: View, state: CameraState) -> None:
        picture, depth = picture_of(view, self.channel), None
        if state.photograph is not None:
            height, width, _ = picture.shape
            if self.photographs.has(state.photograph):
                truth = self.photographs.picture(state.photograph, width, height)
                picture = wiped(truth, picture, self.split)
            picture = in_window(picture, state.width / state.height)
        elif self._drawn_over and self.around.radius < FARTHEST / FARTHER:
            depth = planar_depth(view)
        self.picture = picture
        self.client.scene.set_background_image(picture.numpy(), format="jpeg", jpeg_quality=QUALITY, depth=depth)
        self.client.flush()

    def _notice_leaving(self) -> None:
        if self.photograph is None:
            return
        there = self.photographs.record.cameras.c2w[self.photograph]
        here = self.pose()
        near = float((here[:, 3] - there[:, 3]).norm()) < NEAR * self.around.radius
        if near and float(here[:, 2] @ there[:, 2]) > SAME_WAY:
            self._arrived = True
        elif self._arrived:
            self.photograph = None
            self.on_leave()
