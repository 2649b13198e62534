"""What is drawn over the picture: the cameras of the photographs, and the crop box."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.nerf.geometry.cameras import vertical_field_of_view
from nerf_lightning.nerf.geometry.clipping import CropBox
from nerf_lightning.viewer.camera_state import quaternion_of
from nerf_lightning.viewer.client import ViewerClient

ROOT, CAMERAS, BOX = "/overlay", "/overlay/cameras", "/overlay/crop"
GREY, BLUE = (90, 90, 90), (40, 110, 220)
# Size of a frustum as a share of the photographs' distance.
SCALE = 0.03


class Frusta:
    """Draw the photographs' cameras and the crop box into what one person sees.

    Args:
        session: of that person.
        on_click: called with the view whose camera was clicked.
    """

    def __init__(self, session: ViewerClient, on_click: Callable[[int], None]):
        self.session, self.scene = session, session.client.scene
        self.size = SCALE * session.around.radius
        self.root = self.scene.add_frame(ROOT, show_axes=False)
        self.cameras = self.scene.add_frame(CAMERAS, show_axes=False, visible=False)
        self.on_click, self.has_cameras = on_click, False
        self.box: Any = None

    def show(self, visible: bool) -> None:
        """Show or hide the cameras of the photographs."""
        if visible and not self.has_cameras:
            self.has_cameras = True
            for view in self.session.photographs.shown:
                self._add_camera(view)
        self.cameras.visible = visible
        self.session.draw_over("cameras", visible)

    def hide(self, hidden: bool) -> None:
        """Hide everything while a photograph is compared with its render pixel by pixel, or a path is played."""
        self.root.visible = not hidden

    def draw_box(self, box: CropBox | None) -> None:
        """Draw the crop box, or take it away."""
        if self.box is not None:
            self.box.remove()
            self.box = None
        if box is not None:
            from viser.transforms import SO3

            turned = SO3.from_matrix(box.axes.mT.double().numpy()).wxyz
            middle = (box.corner + 0.5 * box.size @ box.axes).double().numpy()
            size = tuple(box.size.tolist())
            self.box = self.scene.add_box(BOX, BLUE, size, wireframe=True, wxyz=turned, position=middle)
        self.session.draw_over("crop box", box is not None)

    def _add_camera(self, view: int) -> None:
        photographs = self.session.photographs
        cameras = photographs.record.cameras
        width, height = int(cameras.width[view]), int(cameras.height[view])
        fov = vertical_field_of_view(cameras, view)
        thumbnail = photographs.thumbnail(view)
        image = None if thumbnail is None else thumbnail.numpy()
        name, shape = f"{CAMERAS}/{view}", width / height
        handle = draw_camera(self.scene, name, cameras.c2w[view], fov, shape, self.size, GREY, image)
        handle.on_click(self.session.queue.complaints.harmless(lambda _: self.on_click(view)))


def draw_camera(
    scene: Any,
    name: str,
    c2w: Float[Tensor, "3 4"],
    fov: float,
    aspect: float,
    size: float,
    color: tuple[int, int, int],
    image: UInt8[np.ndarray, "height width 3"] | None = None,
) -> Any:
    """Draw a camera as the pyramid that it sees; return viser's handle.

    Args:
        scene: viser's, of one person.
        name: where in viser's tree.
        c2w: where it stands.
        fov: from top to bottom, in radians.
        aspect: width over height.
        size: how far its picture lies from its place (scene units).
        color: red, green and blue, each up to 255.
        image: its picture.
    """
    return scene.add_camera_frustum(
        name,
        fov,
        aspect,
        scale=size,
        thickness=0.02 * size,
        color=color,
        image=image,
        wxyz=quaternion_of(c2w),
        position=c2w[:, 3].double().numpy(),
        cast_shadow=False,
        receive_shadow=False,
    )
